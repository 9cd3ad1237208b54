"""Epochs of training for adaptation: after the last fit only, exact to resume, for every method."""

import dataclasses

import jax
import numpy as np
import pytest

from headway.data import Trajectory
from headway.experiment import loading
from headway.experiment.learners import multi_headed
from headway.experiment.methods import make_config
from headway.planning.last_layer import training as adaptation

TINY = {
    "collection.episode_length": 12,
    "collection.num_iterations": 3,
    "fitting.epochs": 2,
    "model.hidden_sizes": (8, 8),
    "model.context_hidden_sizes": (8,),
}
LAST = TINY["collection.num_iterations"] - 1


def episodes():
    """Two episodes of different lengths."""
    rng = np.random.default_rng(0)
    physics = {"length": 1.0, "mass": 1.0}
    return [
        Trajectory(
            rng.normal(size=(steps + 1, 3)).astype(np.float32),
            rng.uniform(-1, 1, (steps, 1)).astype(np.float32),
            np.zeros(steps, np.float32),
            physics,
        )
        for steps in (12, 7)
    ]


def fit_of(method="tmcl", **settings):
    """A learner, its first state, and its fit of the last iteration."""
    config = make_config("pendulum", method=method, preset="smoke", settings={**TINY, **settings})
    task = loading.load_task(config)
    learner, learned = loading.learner_of(config, task), loading.initial(config, task)
    return learner, learned.fit, learner.fit(episodes(), LAST, jax.random.key(0))


def states(fit, state, first=0):
    return [state for state, _ in fit.epochs(state, first)]


def assert_equal(first, second):
    for a, b in zip(jax.tree.leaves(first), jax.tree.leaves(second), strict=True):
        np.testing.assert_array_equal(a, b)


def test_they_follow_the_last_fit_with_an_adam_of_their_own(monkeypatch):
    plain, calls = multi_headed.fit_blocks, []

    def fit_blocks(state, setup, blocks, **terms):
        calls.append((setup.config.learning_rate, int(state.optimizer[0].count), [*terms]))
        return plain(state, setup, blocks, **terms)

    monkeypatch.setattr(multi_headed, "fit_blocks", fit_blocks)
    learner, start, fit = fit_of(**{"fitting.adaptation_epochs": 2})
    found = states(fit, start)
    assert [learner.num_epochs(i) for i in range(LAST + 1)] == [2, 2, 4]
    assert [rate for rate, _, _ in calls] == [1e-3, 1e-3, *[adaptation.STEP * 1e-3] * 2]
    updates = calls[1][1]
    assert [count for _, count, _ in calls] == [0, updates, 0, updates]
    assert [len(terms) for _, _, terms in calls] == [1, 1, 2, 2]
    *_, ordinary = states(fit_of()[2], start)
    assert_equal(ordinary, found[1])
    weights = [state.model.forward_net.hidden[0].weight for state in found[1:]]
    assert (weights[0] != weights[1]).any((1, 2)).all()
    assert_equal(states(fit, found[1], 2), found[2:])  # as after a stop
    assert_equal(states(fit, found[2], 3), found[3:])


@pytest.mark.slow
@pytest.mark.parametrize(
    "method", ["mcl", "pets", "mh-pets", "vanilla", "stacked", "pets-cadm", "oracle-params", "ria"]
)
def test_any_heads_can_be_trained_so(method):
    _, start, fit = fit_of(method, **{"fitting.epochs": 1, "fitting.adaptation_epochs": 1})
    first, second = fit.epochs(start, 0)
    for state, stats in (first, second):
        assert int(stats.skipped) == 0
        assert np.isfinite(stats.loss)
        assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(state.model))
    before, after = (state.model.forward_net.hidden[0].weight for state, _ in (first, second))
    assert (before != after).any((1, 2)).all()


def test_a_learner_that_was_slowed_down_takes_smaller_steps_here_too():
    learner, *_ = fit_of(**{"fitting.adaptation_epochs": 1})
    slower = adaptation.for_adaptation(learner.slower(0.25).setup)
    assert slower.config.learning_rate == pytest.approx(0.25 * adaptation.STEP * 1e-3)
    unchanged = dataclasses.replace(slower.config, learning_rate=1e-3)
    assert unchanged == learner.config.fitting
