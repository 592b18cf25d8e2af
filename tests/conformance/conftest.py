import pytest

from tests.helpers_pages import isolated_registries


@pytest.fixture(autouse=True)
def isolated():
    """Plug-ins that a test registers are removed at its end."""
    with isolated_registries():
        yield
