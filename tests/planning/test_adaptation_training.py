"""Training for adaptation: the loss is that of the heads that act, and its training helps them."""

import functools

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import toys
from headway.config import FittingConfig, ModelConfig
from headway.data import Trajectory
from headway.models.dynamics import MultiHeadDynamics, Statistics
from headway.models.fitting import FitSetup, fit_epoch, make_data
from headway.planning.last_layer.evidence import MIN_NOISE
from headway.planning.last_layer.regression import (
    LastLayer,
    Observed,
    Prior,
    Seen,
    Shape,
    forecast,
    update,
)
from headway.planning.last_layer.training import AdaptationLoss, Moment, loss_after_learning

STEPS, HISTORY = 9, 3


def fit_data(trajectories, setup, statistics=None, members=2):
    longest = max(len(trajectory) for trajectory in trajectories)
    episodes, samples = toys.lay_out(
        trajectories, max_length=longest + 2, future_length=setup.config.future_length
    )
    if statistics is None:
        statistics = Statistics.fit(toys.POINT, trajectories, setup.history_length)
    key = jax.random.key(9)
    return make_data(episodes, samples, statistics, setup.config, num_members=members, key=key)


@pytest.fixture(scope="module")
def odd_data():
    """Two short episodes; everything is shifted and scaled."""
    trajectories = [toys.random_trajectory(STEPS - n, n) for n in range(2)]
    return fit_data(
        trajectories, FitSetup(toys.POINT, FittingConfig(), HISTORY), toys.odd_statistics()
    )


def moment(episode, step):
    return Moment(jnp.asarray(episode), jnp.asarray(step))


@eqx.filter_jit
def seen_at(model, data, episode, step, past):
    """One transition as an agent sees it, with the context of some moment."""
    rows = jnp.full((2, 1), episode), jnp.full((2, 1), past)
    context = model.context(data.episodes.history(*rows, HISTORY), data.statistics)
    obs, action = data.episodes.obs[episode], data.episodes.action[episode]
    transition = obs[step][None], action[step][None], obs[step + 1][None]
    return Seen.through(model, toys.POINT, data.statistics, transition, context)


def prior_of(ratio, shape=None):
    return Prior(jnp.broadcast_to(jnp.asarray(ratio), 2), jnp.ones((2, 2)), jnp.zeros(2), shape)


def spread(size):
    """A prior that is spread unevenly over the features, otherwise in each member."""
    rng = np.random.default_rng(size)
    root = np.eye(size) * rng.uniform(0.5, 2.0, size) + 0.1 * rng.normal(size=(2, size, size))
    return Shape(*(jnp.asarray(x, jnp.float32) for x in (root, np.linalg.inv(root))))


@eqx.filter_jit
def at(loss, model, data, moment):
    return loss.at(model, data, moment)


@pytest.mark.parametrize(
    ("episode", "learned", "shape"), [(0, 1, None), (0, 5, spread(12)), (1, 7, None)]
)
def test_the_loss_is_that_of_heads_which_learned_step_by_step(odd_data, episode, learned, shape):
    """The filter that acts learns from the first transitions, and predicts the others."""
    model, length = toys.small_model(), STEPS - episode
    prior = prior_of([0.5, 20.0], shape)
    layer, everywhere = LastLayer.of_prior(prior, 1, (2, 12, 2)), jnp.ones(1, bool)
    squares = np.zeros((2, 2))
    for step in range(learned):
        seen = seen_at(model, odd_data, *map(jnp.asarray, (episode, step, step + 1)))
        squares += np.square(seen.residual[0]).sum(-1)
        observed = Observed.of(seen, everywhere)
        layer = update(layer, observed, forecast(layer, observed))
    errors, spreads = [], []
    for step in range(learned, length):
        seen = seen_at(model, odd_data, *map(jnp.asarray, (episode, step, learned)))
        squares += np.square(seen.residual[0]).sum(-1)
        expected = forecast(layer, Observed.of(seen, everywhere))
        errors.append(np.asarray(expected.innovation[0], np.float64))
        spreads.append(np.asarray(expected.spread[0, :, 0], np.float64))
    error, wide = np.square(errors), np.asarray(spreads)
    noise = (error / wide[:, :, None, None]).mean(0)
    wanted = np.log(noise).mean((1, 2)) + np.log(wide).mean(0)
    loss = AdaptationLoss(toys.POINT, HISTORY, prior)
    found = at(loss, model, odd_data, moment(episode, learned))
    np.testing.assert_allclose(found, wanted, rtol=2e-4)


def twin(features, residual, learned, judged, ratio):
    """The loss by batch regression, in float64."""
    first, size = features[learned], features.shape[1]
    covariance = np.linalg.inv(first.T @ first + np.eye(size) / ratio)
    weight = np.einsum("ij,tj,tko->iko", covariance, first, residual[learned])
    error = np.square(residual - np.einsum("ti,iko->tko", features, weight))[judged]
    spread = 1.0 + np.einsum("ti,ij,tj->t", features, covariance, features)[judged]
    noise = (error / spread[:, None, None]).mean(0)
    return np.log(np.maximum(noise, MIN_NOISE)).mean() + np.log(spread).mean()


@pytest.mark.parametrize("ratio", [1e-3, 1.0, 1e6])
def test_the_loss_and_its_gradient_equal_batch_regression_in_float64(ratio):
    rng = np.random.default_rng(0)
    features = rng.normal(size=(30, 6)) * np.geomspace(1.0, 1e-2, 6)
    residual = np.einsum("ti,iko->tko", features, rng.normal(size=(6, 2, 3)))
    residual += 0.05 * rng.normal(size=residual.shape)
    moved = [rng.normal(size=x.shape) * np.abs(x).mean() for x in (features, residual)]
    steps = np.arange(30)
    learned, judged = steps < 12, (steps >= 12) & (steps < 25)

    def wanted(shift):
        args = (x + shift * by for x, by in zip((features, residual), moved, strict=True))
        return twin(*args, learned, judged, ratio)

    def found(shift, judged):
        args = (x + shift * by for x, by in zip((features, residual), moved, strict=True))
        args = [jnp.asarray(x, jnp.float32) for x in args]
        return loss_after_learning(*args, jnp.asarray(12), judged, jnp.float32(ratio))

    loss, slope = jax.jit(jax.value_and_grad(found))(jnp.float32(0), jnp.asarray(judged))
    assert loss == pytest.approx(wanted(0.0), abs=2e-3)
    assert slope == pytest.approx((wanted(1e-5) - wanted(-1e-5)) / 2e-5, rel=5e-3)
    assert found(0.0, jnp.zeros(30, bool)) == 0.0


@eqx.filter_jit
@eqx.filter_grad
def gradient(model, loss, data, moment):
    return loss.at(model, data, moment).sum()


@pytest.mark.parametrize("ratio", [1.0, 1e7])
def test_it_teaches_features_and_contexts_but_not_heads(odd_data, ratio):
    model = toys.small_model()
    loss = AdaptationLoss(toys.POINT, HISTORY, prior_of(ratio))
    grads = gradient(model, loss, odd_data, moment(0, 4))
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(grads))
    taught = [grads.forward_net.hidden, grads.context_encoder]
    assert all((np.abs(leaf).sum() > 0) for leaf in jax.tree.leaves(taught))
    kept = [grads.forward_net.mean_heads, grads.forward_net.logvar_heads, grads.backward_net]
    assert all((np.asarray(leaf) == 0).all() for leaf in jax.tree.leaves(kept))


def test_moments_leave_something_to_learn_from_and_something_to_predict(odd_data):
    keys = jax.random.split(jax.random.key(0), 200)
    draws = jax.jit(jax.vmap(functools.partial(Moment.draw, odd_data)))(keys)
    episode, step = map(np.asarray, draws)
    assert {*episode} == {0, 1}
    assert {*step[episode == 0]} == {*range(1, STEPS)}
    assert {*step[episode == 1]} == {*range(1, STEPS - 1)}
    assert (step <= 3).mean() > 0.55  # log-uniform: 0.63 in the longer episode


def of_family(seed, steps=24):
    """An episode whose delta is a random mixture of three functions of state and action."""
    rng = np.random.default_rng(seed)
    mixture = rng.normal(size=(3, 2))
    action = rng.uniform(-1, 1, (steps, 2)).astype(np.float32)
    obs = [rng.uniform(-1, 1, 2)]
    for push in action:
        bases = np.array([np.sin(3 * obs[-1][0]), push[0] * np.cos(3 * obs[-1][1]), push[1]])
        obs.append(0.5 * obs[-1] + 0.5 * np.tanh(bases @ mixture))
    zeros = np.zeros(steps, np.float32)
    return Trajectory(np.asarray(obs, np.float32), action, zeros, {"gain": 1.0})


def test_held_out_tasks_are_learned_better_after_training_for_it():
    """Better than before, and than after as many ordinary epochs."""
    config = ModelConfig(
        num_members=2, num_heads=2, hidden_sizes=(16, 16), context_size=0, backward_net=False
    )
    fitting = FittingConfig(learning_rate=0.01, batch_size=64, future_length=1, weight_decay=0.0)
    setup = FitSetup(toys.POINT, fitting, HISTORY)
    data = fit_data([of_family(n) for n in range(24)], setup)
    held_out = fit_data([of_family(100 + n) for n in range(12)], setup, data.statistics)
    loss = AdaptationLoss(toys.POINT, HISTORY, prior_of(100.0))
    state = setup.init(MultiHeadDynamics.init(config, toys.POINT, key=jax.random.key(0)))

    def epochs(state, count, first, extra=None):
        for n in range(first, first + count):
            key = jax.random.key(n)
            state, stats = fit_epoch(state, setup, data, independent=False, key=key, extra=extra)
            assert int(stats.skipped) == 0
        return state

    @eqx.filter_jit
    def of_held_out(model):
        moments = Moment(jnp.repeat(jnp.arange(12), 2), jnp.tile(jnp.asarray([6, 12]), 12))
        return jax.vmap(functools.partial(loss.at, model, held_out))(moments).mean()

    fitted = epochs(state, 15, 0)
    plain, trained = epochs(fitted, 15, 15), epochs(fitted, 15, 15, loss)
    before, after_plain, after = (
        float(of_held_out(state.model)) for state in (fitted, plain, trained)
    )
    assert after < min(before, after_plain) - 0.1
