"""Acting from a run: any iteration, another planner, learning heads, a copy that lacks files."""

import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

import headway
import runs
import toys
from headway.errors import ConfigError, RunError
from headway.training.methods import config_to_evaluate
from headway.training.run import RunDir
from headway.training.trainers import load_agent, make_trainer

OBS = np.array([1.0, 0.0, 0.0])
LAST_LAYER = {"planner.adaptation": "last-layer"}


def test_a_controller_can_go_on_learning(root):
    controller = headway.load(root, settings=LAST_LAYER)
    for _ in range(2):
        controller.act(OBS)
    assert controller.agent.model.prior is not None
    assert np.abs(controller._state.belief.last_layer.weight).max() > 0
    with pytest.raises(ConfigError, match=r"evaluation\.num_episodes cannot change here"):
        headway.load(root, settings={"evaluation.num_episodes": 3})


def test_a_run_of_frozen_heads_is_tested_with_heads_that_learn(two_iterations):
    frozen, learning = (
        headway.evaluate(two_iterations, groups=["train"], num_episodes=2, settings=settings)
        for settings in ({}, LAST_LAYER)
    )
    returns = [[row.episode_return for row in rows] for rows in (frozen, learning)]
    assert np.isfinite(returns).all()
    assert returns[0] != returns[1]


def test_the_prior_of_a_loaded_agent_comes_from_all_its_data(two_iterations):
    run = RunDir(two_iterations)
    config = config_to_evaluate(run.config(), LAST_LAYER)
    agent, trainer = load_agent(run, config), make_trainer(config)
    assert agent.model.prior.root.shape[0] == agent.model.net.num_members
    part = trainer.agent(trainer.load(run), run.load_data()[:1])
    assert (part.model.prior.noise != agent.model.prior.noise).all()
    assert load_agent(run).model.prior is None


def test_an_earlier_iteration_acts_as_it_did_then(reference, two_iterations):
    found, then = (
        headway.load(path, iteration=1, settings=LAST_LAYER).agent.model
        for path in (reference, two_iterations)
    )
    toys.assert_equal(found, then)


def test_the_newest_iterations_and_the_best_are_kept(tmp_path):
    run = RunDir(tmp_path)
    run.begin(runs.tiny_config(**{"collection.num_checkpoints": 3}))
    for i, collected in enumerate([99.0, 5.0, 9.0, 1.0, 2.0, 3.0, 4.0]):
        metrics = {"iteration": i, "collection": {"return_mean": collected}}
        run.save_iteration(metrics, (), [], {}, {})
    run.begin(runs.tiny_config())
    assert [run.kept_iteration(wanted) for wanted in (None, "best", 5)] == [6, 1, 5]
    with pytest.raises(RunError, match="keeps no iteration 2, allowed: 1, 4, 5, 6; "):
        run.kept_iteration(2)
    for iteration in (4, 5, 6):
        (tmp_path / f"checkpoints/iteration-00{iteration}.safetensors").write_bytes(b"")
    assert run.go_back() == 1
    run.begin(runs.tiny_config())
    assert run.finished_iterations == 2


SERVED = ("config.json", "checksums/iteration-001.json", "checkpoints/iteration-001.safetensors")


def copy_of(root: Path, names) -> Path:
    """A run directory with some files of another one."""
    place = root.with_name("copy")
    for name in names:
        (place / name).parent.mkdir(parents=True, exist_ok=True)
        shutil.copy(root / name, place / name)
    return place


def test_a_copy_without_tables_and_data_serves(root):
    copy = copy_of(root, SERVED)
    np.testing.assert_array_equal(headway.load(copy).act(OBS), headway.load(root).act(OBS))


@pytest.mark.parametrize("missing", SERVED)
def test_a_file_that_a_copy_lacks_is_named(missing, root):
    copy = copy_of(root, [name for name in SERVED if name != missing])
    with pytest.raises(RunError, match=missing.split("/")[0]) as caught:
        headway.load(copy)
    assert "go on training" not in str(caught.value)


def test_learning_on_needs_the_data_as_well(root):
    with pytest.raises(RunError, match="data/iteration-000"):
        headway.load(copy_of(root, SERVED), settings=LAST_LAYER)


def test_a_controller_is_loaded_without_a_simulator(root):
    code = f"import headway, sys; headway.load({str(root)!r}); print(*sys.modules)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    loaded = set(done.stdout.split())
    assert "headway.planning.controller" in loaded
    assert not {"gymnasium", "mujoco", "matplotlib"} & loaded
