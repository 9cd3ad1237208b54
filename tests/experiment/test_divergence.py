"""A fit that diverges is rolled back, slowed down, and in the end explained."""

import dataclasses
import signal
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
from headway.models.updates import EpochStats
from headway.storage.interrupts import Terminated

sys.path.append(str(Path(__file__).parent.parent / "chaos"))
import killing
from killing import Listening


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


def fail(monkeypatch, *, first, times):
    """Let some fits of epochs fail; returns the step size of every epoch that was fitted."""
    plain, rates = multi_headed.fit_epoch, []

    def fit_epoch(state, setup, data, **terms):
        rates.append(setup.config.learning_rate)
        state, found = plain(state, setup, data, **terms)
        if first <= len(rates) <= first + times - 1:
            return jax.tree.map(lambda x: x * 0, state), found._replace(skipped=found.updates)
        return state, found

    monkeypatch.setattr(multi_headed, "fit_epoch", fit_epoch)
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


class Stopping(Listening):
    """Asks the run to stop at the n-th thing said, or at the first epoch after it."""

    def __init__(self, at, *, epoch=False):
        super().__init__()
        self.at, self.epoch = at, epoch

    def message(self, text):
        super().message(text)
        if len(self.said) == self.at and not self.epoch:
            signal.raise_signal(signal.SIGTERM)

    def advance(self, amount=1, **values):
        if len(self.said) == self.at and self.epoch:
            signal.raise_signal(signal.SIGTERM)


def fail_in_epoch(monkeypatch, *, at, above):
    """Let the epoch from the `at`-th update diverge, unless its step is small enough."""
    plain, rates = multi_headed.fit_epoch, []

    def fit_epoch(state, setup, data, **terms):
        rates.append(setup.config.learning_rate)
        begins = int(state.optimizer[0].count)
        state, found = plain(state, setup, data, **terms)
        if begins == at and rates[-1] > above:
            return jax.tree.map(lambda x: x * 0, state), found._replace(skipped=found.updates)
        return state, found

    monkeypatch.setattr(multi_headed, "fit_epoch", fit_epoch)
    return rates


@pytest.mark.parametrize(("number", "at", "epoch"), [(1, 2, False), (1, 2, True), (0, 1, False)])
def test_a_stop_during_a_roll_back_goes_on_as_if_there_was_none(
    number, at, epoch, tmp_path, monkeypatch
):
    config = killing.tiny_config()
    updates = 6 + 3 * number  # before that epoch of the second iteration
    usual = config.fitting.learning_rate
    rates = fail_in_epoch(monkeypatch, at=updates, above=usual / 10)
    heard = Listening()
    whole = training.train_run(config, tmp_path / "whole", heard)
    assert [row["fitting"]["rollbacks"] for row in whole.metrics()] == [0, 2, 0]
    assert all(f"epoch {number} of iteration 1" in text for text in heard.said)
    once = len(rates)
    rates.clear()
    stopping = Stopping(at, epoch=epoch)
    with pytest.raises(Terminated):
        training.train_run(config, tmp_path / "cut", stopping)
    assert stopping.said == heard.said[:at]
    training.train_run(config, tmp_path / "cut")
    assert killing.result(tmp_path / "cut") == killing.result(tmp_path / "whole")
    # An epoch that diverged is not kept, and diverges once more in the same way.
    assert len(rates) == once + (0 if epoch else at)


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


def test_a_head_that_wins_nothing_is_harmless():
    """It keeps its weights but for weight decay, owns nothing, and the agent acts without it."""
    config = killing.tiny_config(**{"fitting.weight_decay": 0.0})
    task = loading.load_task(config)
    learner, learned = loading.learner_of(config, task), loading.initial(config, task)
    heads = learned.fit.model.forward_net.mean_heads
    far = heads.bias.at[:, 1].set(1e3)
    model = jax.tree.map(lambda x: far if x is heads.bias else x, learned.fit.model)
    learned = Learned(dataclasses.replace(learned.fit, model=model), learned.statistics)
    data = [t for steps in (6, 1, 3) for t in episodes(steps=steps)]
    fit = learner.fit(data, 5, jax.random.key(0))
    for state, found in fit.epochs(learned.fit, 0):
        assert int(found.skipped) == 0
        assert np.isfinite(found.loss)
        learned = Learned(state, fit.statistics)
    fitted = learned.fit.model.forward_net.mean_heads
    np.testing.assert_array_equal(fitted.bias[:, 1], 1e3)
    np.testing.assert_array_equal(fitted.weight[:, 1], heads.weight[:, 1])
    assert (fitted.weight[:, [0, 2]] != heads.weight[:, [0, 2]]).any((1, 2, 3)).all()
    shares = learner.head_shares(learned, data)
    assert {row["share"] for row in shares if row["head"] == 1} == {0.0}
    assert sum(row["share"] for row in shares if row["member"] == 0) == pytest.approx(1.0)
    agent = learner.agent(learned)
    state = agent.init(1, key=jax.random.key(0))
    for obs in data[0].obs[:3]:
        state, decision = agent.act(state, obs[None])
        assert np.isfinite(decision.action).all()
