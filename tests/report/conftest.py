"""Figures are drawn where a test asks for them."""

import pytest

from tests.helpers_report import without_figures
from vd4rl_pomdp.report import figures


@pytest.fixture
def drawn() -> None:
    """A test with this one gets figures, in the page alone."""


@pytest.fixture
def figure_files() -> None:
    """A test with this one gets the files of figures, too."""


@pytest.fixture(autouse=True)
def _fewer_figures(monkeypatch, request):
    if "figure_files" not in request.fixturenames:
        monkeypatch.setattr(figures, "FORMATS", {})
        if "drawn" not in request.fixturenames:
            without_figures(monkeypatch)
