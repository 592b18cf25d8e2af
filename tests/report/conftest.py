"""Figures are drawn for the page alone, unless a test asks for their files."""

import pytest

from vd4rl_pomdp.report import figures


@pytest.fixture
def figure_files() -> None:
    """A test with this one gets the files of figures, too."""


@pytest.fixture(autouse=True)
def _page_alone(monkeypatch, request):
    if "figure_files" not in request.fixturenames:
        monkeypatch.setattr(figures, "FORMATS", {})
