"""Figures are drawn only for tests that request them."""

import pytest

from tests.helpers_report import without_figures
from vd4rl_pomdp.report import figures


@pytest.fixture
def drawn() -> None:
    """Draw figures in the page, but write no figure files."""


@pytest.fixture
def figure_files() -> None:
    """Draw figures and write their files."""


@pytest.fixture(autouse=True)
def _fewer_figures(monkeypatch, request):
    if "figure_files" not in request.fixturenames:
        monkeypatch.setattr(figures, "FORMATS", {})
        if "drawn" not in request.fixturenames:
            without_figures(monkeypatch)
