"""Training and figures that take no time."""

import fakes
import pytest

from headway.lab import comparison


@pytest.fixture
def training(monkeypatch):
    fake = fakes.FakeTraining()
    monkeypatch.setattr(comparison, "run_jobs", fake)
    return fake


@pytest.fixture
def without_figures(monkeypatch):
    """Figures take long to draw."""
    monkeypatch.setattr(comparison, "draw", lambda found: [])
