"""Runs whose heads keep learning: trained, resumed, and tested without having been trained so."""

import shutil
from pathlib import Path

import jax
import numpy as np
import pytest

import headway
from headway.experiment import loading
from headway.experiment.methods import config_to_evaluate, make_config
from headway.experiment.rollouts import Arena, Episode, random_policy, run_episodes
from headway.storage.arrays import tree_arrays, tree_from_arrays
from headway.storage.run_dir import RunDir

OLD_RUN = Path(__file__).parents[1] / "data" / "run-schema-1"
LAST_LAYER = {"planner.adaptation": "last-layer"}


@pytest.fixture
def old_run(tmp_path):
    return shutil.copytree(OLD_RUN, tmp_path / "old")


def test_a_run_of_frozen_heads_is_tested_with_heads_that_learn(old_run):
    frozen, learning = (
        headway.evaluate(old_run, groups=["train"], num_episodes=2, settings=settings)
        for settings in ({}, LAST_LAYER)
    )
    returns = [[row.episode_return for row in rows] for rows in (frozen, learning)]
    assert np.isfinite(returns).all()
    assert returns[0] != returns[1]


def test_the_prior_of_a_loaded_agent_comes_from_all_its_data(old_run):
    run = RunDir(old_run)
    config = config_to_evaluate(run.config(), LAST_LAYER)
    agent = loading.load_agent(run, config)
    assert agent.prior.ratio.shape == (agent.model.num_members,)
    learned, task = loading.load_learned(run, config), loading.load_task(config)
    learner = loading.learner_of(config, task)
    part = learner.agent(learned, trajectories=run.load_data()[:1])
    assert (part.prior.noise != agent.prior.noise).all()
    assert loading.load_agent(run).prior is None


def test_what_was_learned_survives_a_stop_in_the_middle_of_an_episode(old_run, tmp_path):
    settings = LAST_LAYER | {"planner.change_threshold": 5.0}
    agent = loading.load_agent(
        RunDir(old_run), config_to_evaluate(RunDir(old_run).config(), settings)
    )
    state = agent.init(2, key=jax.random.key(0))
    for _ in range(3):
        state, _ = agent.act(state, np.full((2, agent.task.obs_size), 0.3, np.float32))
    back = tree_from_arrays(state, tree_arrays(state, "state."), tmp_path, "state.")
    for got, want in zip(jax.tree.leaves(back), jax.tree.leaves(state), strict=True):
        np.testing.assert_array_equal(
            *(jax.random.key_data(x) if x.dtype == state.key.dtype else x for x in (got, want))
        )


def test_episodes_follow_their_own_schedules():
    config = make_config("pendulum", preset="smoke")
    arena, length = Arena.make(config), {"length": 1.0, "mass": 1.0}
    plain, changing = Episode(length, 1), Episode(length, 1, {5: {"length": 0.3}})

    def roll_out(*episodes):
        policy = random_policy(arena, np.random.default_rng(0))
        found = run_episodes(arena, episodes, policy).trajectories
        return [trajectory.obs for trajectory in found]

    (first, _), (same, changed) = roll_out(plain, plain), roll_out(plain, changing)
    np.testing.assert_array_equal(first, same)
    second = roll_out(plain, plain)[1]
    np.testing.assert_array_equal(second[:6], changed[:6])
    assert (second[6:] != changed[6:]).any(-1).all()
