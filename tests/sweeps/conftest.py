"""Training and figures that take no time."""

import fakes
import pytest

from headway import compare
from headway.sweeps import running


@pytest.fixture
def training(monkeypatch):
    fake = fakes.FakeTraining()
    monkeypatch.setattr(running, "train_run", fake)
    return fake


@pytest.fixture
def without_figures(monkeypatch):
    """Figures take long to draw."""
    monkeypatch.setattr(compare, "draw_comparison", lambda found: [])
