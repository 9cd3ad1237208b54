"""The environments in `examples/`, as a user has them."""

import importlib
import sys
from pathlib import Path

import gymnasium
import pytest

import headway
from headway.task import name_spec
from headway.training.check import findings

EXAMPLES = Path(__file__).parent.parent / "examples"
NAMES = sorted(path.stem for path in EXAMPLES.glob("*.py"))


@pytest.fixture
def example(monkeypatch):
    """Imports an example from its folder; skips what this machine cannot run."""
    monkeypatch.setattr(sys, "path", [str(EXAMPLES), *sys.path])

    def load(name):
        if name == "dm_cartpole":
            pytest.importorskip("shimmy")
            try:
                gymnasium.make("shimmy:dm_control/cartpole-swingup-v0").close()
            except (AttributeError, ImportError, gymnasium.error.Error) as error:
                pytest.skip(f"dm_control is missing or does not know this MuJoCo: {error}")
        return importlib.import_module(name).spec

    return load


@pytest.mark.parametrize("name", NAMES)
def test_an_example_is_short_and_its_task_agrees_with_its_environment(name, example):
    assert len((EXAMPLES / f"{name}.py").read_text().splitlines()) < 60
    config = headway.make_config(name_spec(example(name)), preset="smoke")
    faults = [found for found in findings(config) if found.status == "fault"]
    assert not faults
