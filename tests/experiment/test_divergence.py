"""A fit that diverges is rolled back, slowed down, and in the end explained."""

import dataclasses
import sys
from pathlib import Path

import jax
import numpy as np
import pytest

from headway.data import Trajectory
from headway.errors import DivergenceError
from headway.experiment import loading, training
from headway.experiment.divergence import divergence, first_non_finite
from headway.experiment.learners import Learned, multi_headed
from headway.experiment.progress import Progress
from headway.models.fitting import EpochStats

sys.path.append(str(Path(__file__).parent.parent / "chaos"))
import killing


def stats(loss=1.0, skipped=0, updates=10):
    return EpochStats(*(np.asarray(x) for x in (loss, loss, skipped, updates)))


@pytest.mark.parametrize(
    ("epoch", "problem"),
    [
        (stats(), None),
        (stats(skipped=5), None),
        (stats(skipped=6), "6 of 10 updates had no finite loss and gradient"),
        (stats(90.0), None),
        (stats(110.0), "the loss rose from 0.5 to 110"),
        (stats(float("nan")), "the loss rose from 0.5 to nan"),
    ],
)
def test_what_counts_as_divergence(epoch, problem):
    assert divergence(epoch, [stats(0.5), stats(2.0)]) == problem


def test_a_first_loss_may_be_large():
    assert divergence(stats(1e9), []) is None


class Listening(Progress):
    def __init__(self):
        self.said = []

    def message(self, text):
        self.said.append(text)


def fail(monkeypatch, *, first, times):
    """Let some fits of epochs fail; returns the step size of every epoch that was fitted."""
    plain, rates = multi_headed.fit_blocks, []

    def fit_blocks(state, setup, blocks, *, independent):
        rates.append(setup.config.learning_rate)
        state, found = plain(state, setup, blocks, independent=independent)
        if first <= len(rates) <= first + times - 1:
            return jax.tree.map(lambda x: x * 0, state), found._replace(skipped=found.updates)
        return state, found

    monkeypatch.setattr(multi_headed, "fit_blocks", fit_blocks)
    return rates


def test_a_diverging_epoch_is_made_again_with_a_smaller_step(tmp_path, monkeypatch):
    rates = fail(monkeypatch, first=5, times=2)  # the second epoch of the second iteration
    heard = Listening()
    run = training.train_run(killing.tiny_config(), tmp_path / "run", heard)
    assert [row["fitting"]["rollbacks"] for row in run.metrics()] == [0, 2, 0]
    usual = killing.tiny_config().fitting.learning_rate
    slower = [usual, usual / 4, usual / 16, usual / 16]
    np.testing.assert_allclose(rates, [usual] * 4 + slower + [usual] * 3)
    assert [text for text in heard.said if "epoch 1 of iteration 1" in text] == heard.said
    assert len(heard.said) == 2


def test_what_diverges_for_good_stops_with_all_that_was_good(tmp_path, monkeypatch):
    with monkeypatch.context() as patch:
        fail(patch, first=5, times=100)
        with pytest.raises(DivergenceError, match="epoch 1 of iteration 1 diverged 4 times") as e:
            training.train_run(killing.tiny_config(), tmp_path / "run")
    assert "every member and head has a finite loss before" in str(e.value)
    training.train_run(killing.tiny_config(), tmp_path / "run")
    training.train_run(killing.tiny_config(), tmp_path / "whole")
    assert killing.result(tmp_path / "run") == killing.result(tmp_path / "whole")


def fresh():
    config = killing.tiny_config()
    task = loading.load_task(config)
    return loading.learner_of(config, task), loading.initial(config, task)


def episodes(scale=1.0, steps=6, *, constant=False, dtype=np.float32):
    rng = np.random.default_rng(0)
    found = []
    for _ in range(3):
        obs = scale * rng.normal(size=(steps + 1, 3))
        if constant:
            obs[:, 2] = scale
        action = rng.uniform(-1, 1, (steps, 1)).astype(np.float32)
        found.append(Trajectory(obs.astype(dtype), action, np.zeros(steps), {"length": 1.0}))
    return found


def test_the_member_the_head_and_the_physics_are_named():
    learner, learned = fresh()
    heads = learned.fit.model.forward_net.mean_heads
    broken = heads.bias.at[1, 2].set(np.nan)
    model = jax.tree.map(lambda x: broken if x is heads.bias else x, learned.fit.model)
    learned = Learned(dataclasses.replace(learned.fit, model=model), learned.statistics)
    found = first_non_finite(episodes(), list(learner.head_losses(learned, episodes())))
    assert found == "member 1, head 2, at step 0 under sim_params {'length': 1.0}"


@pytest.mark.parametrize(
    "settings",
    [{"scale": 1e8}, {"scale": 1e-8}, {"constant": True}, {"steps": 1}, {"dtype": np.float64}],
    ids=str,
)
def test_odd_data_are_fitted_with_finite_numbers(settings):
    learner, learned = fresh()
    fit = learner.fit(episodes(**settings), 5, jax.random.key(0))
    for state, found in fit.epochs(learned.fit, 0):
        assert int(found.skipped) == 0
        assert np.isfinite(found.loss)
        assert all(np.isfinite(x).all() for x in jax.tree.leaves(state.model))
