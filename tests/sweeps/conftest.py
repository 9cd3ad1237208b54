"""Training and figures that take no time."""

import fakes
import pytest

from headway.lab import comparison
from headway.sweeps import running


@pytest.fixture
def training(monkeypatch):
    fake = fakes.FakeTraining()
    monkeypatch.setattr(running, "train_run", fake)
    return fake


@pytest.fixture
def without_figures(monkeypatch):
    """Figures take long to draw."""
    monkeypatch.setattr(comparison, "draw", lambda found: [])
