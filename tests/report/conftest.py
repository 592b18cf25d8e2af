"""Figures are drawn where a test asks for them."""

import pytest

from vd4rl_pomdp.report import figures, page

SECTIONS = ("scores", "profiles", "curves", "probes", "errors", "costs", "losses")


@pytest.fixture
def drawn() -> None:
    """A test with this one gets figures, in the page alone."""


@pytest.fixture
def figure_files() -> None:
    """A test with this one gets the files of figures, too."""


@pytest.fixture(autouse=True)
def _without_figures(monkeypatch, request):
    if "figure_files" in request.fixturenames:
        return
    monkeypatch.setattr(figures, "FORMATS", {})
    if "drawn" not in request.fixturenames:
        monkeypatch.setattr(page, "_plots", lambda runs, made: {name: [] for name in SECTIONS})
