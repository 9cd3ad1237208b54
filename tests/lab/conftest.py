"""Runs written by hand, and training that takes no time."""

import shutil

import fakes
import pytest

from headway.lab import comparison, sweep


@pytest.fixture
def run_dir(tmp_path):
    return fakes.write(tmp_path / "run")


@pytest.fixture(scope="session")
def written(tmp_path_factory):
    """Two methods on Pendulum over three seeds, with both references; only to be read."""
    root = tmp_path_factory.mktemp("written")
    for method, lift in fakes.LIFTS.items():
        for seed in range(3):
            fakes.write(root / f"{method}-{seed}", method, seed=seed, lift=lift)
    return root


@pytest.fixture
def folder(written, tmp_path):
    """A copy of them, to be changed."""
    return shutil.copytree(written, tmp_path / "runs")


@pytest.fixture(autouse=True)
def impatient(monkeypatch):
    """Runs that were lost or are held are tried again soon."""
    monkeypatch.setattr(sweep, "PATIENCE", 0.2)


@pytest.fixture
def training(monkeypatch):
    """Training that takes no time."""
    fake = fakes.FakeTraining()
    monkeypatch.setattr(comparison, "run_jobs", fake)
    return fake


@pytest.fixture
def without_figures(monkeypatch):
    """Figures take long to draw."""
    monkeypatch.setattr(comparison, "draw", lambda found: [])
