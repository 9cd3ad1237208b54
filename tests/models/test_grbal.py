"""GrBAL's inner and outer steps against twins in NumPy and against finite differences."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from adaptive_helpers import TINY, random_window, toy_data

import toys
from headway.models.fitting import FitState
from headway.models.grbal import (
    ReluNet,
    Window,
    adapt,
    meta_epoch,
    meta_loss,
    squared_error,
    window,
)


def tiny_net(seed=0, sizes=(5,), task=toys.POINT):
    config = dataclasses.replace(TINY, hidden_sizes=sizes)
    return ReluNet.init(config, task, key=jax.random.key(seed))


def twin_loss(weights, window):
    """The squared error of a net of one hidden layer, in NumPy's float64."""
    w1, b1, w2, b2 = weights
    prediction = np.maximum(window.x @ w1 + b1, 0) @ w2 + b2
    errors = np.square(prediction - window.delta).mean(-1)
    return (window.weight * errors).sum() / window.weight.sum()


def twin_gradient(weights, window):
    """Backpropagation by hand."""
    w1, b1, w2, b2 = weights
    before = window.x @ w1 + b1
    hidden = np.maximum(before, 0)
    share = window.weight[:, None] / window.weight.sum() / window.delta.shape[-1]
    error = 2 * share * (hidden @ w2 + b2 - window.delta)
    back = (error @ w2.T) * (before > 0)
    return window.x.T @ back, back.sum(0), hidden.T @ error, error.sum(0)


def as_twin(net):
    (hidden,) = net.hidden
    layers = (hidden.weight, hidden.bias, net.output.weight, net.output.bias)
    return [np.asarray(x[0], np.float64) for x in layers]


def twin_meta_loss(weights, past, future, rate):
    """Adapt by hand, then judge; averaged over tasks."""
    losses = []
    for task in range(len(past.weight)):
        before, after = (jax.tree.map(lambda x: x[task], w) for w in (past, future))  # noqa: B023
        steps = twin_gradient(weights, before)
        adapted = [w - rate * g for w, g in zip(weights, steps, strict=True)]
        losses.append(twin_loss(adapted, after))
    return np.mean(losses)


def test_an_adapted_net_is_one_step_of_gradient_descent_by_hand():
    net, past = tiny_net(), random_window(1, 6)
    found = as_twin(adapt(net, past, 0.3))
    weights, past = as_twin(net), toys.f64(past)
    steps = twin_gradient(weights, past)
    for after, before, step in zip(found, weights, steps, strict=True):
        np.testing.assert_allclose(after, before - 0.3 * step, rtol=1e-5, atol=1e-6)


@pytest.mark.parametrize("rate", [0.0, 0.2])
def test_inner_and_outer_gradients_equal_finite_differences(rate):
    net, past, future = tiny_net(), random_window(1, 3, 6), random_window(2, 3, 6)
    inner = jax.grad(squared_error)(net, jax.tree.map(lambda x: x[0], past))
    outer = jax.grad(meta_loss)(net, past, future, rate)
    weights, past, future = as_twin(net), toys.f64(past), toys.f64(future)
    first = jax.tree.map(lambda x: x[0], past)
    losses = (
        (inner, lambda w: twin_loss(w, first)),
        (outer, lambda w: twin_meta_loss(w, past, future, rate)),
    )
    assert np.isclose(meta_loss(net, past, future, rate), losses[1][1](weights), rtol=1e-5)
    for found, loss in losses:
        for place, gradient in enumerate(as_twin(found)):
            for index in np.ndindex(gradient.shape):
                sides = []
                for sign in (1, -1):
                    moved = [w.copy() for w in weights]
                    moved[place][index] += sign * 1e-6
                    sides.append(loss(moved))
                expected = (sides[0] - sides[1]) / 2e-6
                np.testing.assert_allclose(gradient[index], expected, rtol=2e-3, atol=2e-5)


def setup_of(batch_size=64, learning_rate=3e-3):
    return toys.make_setup(1, batch_size=batch_size, learning_rate=learning_rate)


def fit(state, setup, data, key=0, length=4, rate=0.05):
    return meta_epoch(state, setup, data, length=length, rate=rate, key=jax.random.key(key))


def test_windows_are_transitions_of_one_episode_and_weigh_nothing_outside():
    data, trajectories = toy_data([1.0, 2.0, 0.5])
    episode, start = jnp.array([2, 0, 1]), jnp.array([39, -2, 10])
    found = window(toys.POINT, data, episode, start, 4)
    np.testing.assert_array_equal(found.weight, [[1, 0, 0, 0], [0, 0, 1, 1], [1, 1, 1, 1]])
    source = trajectories[1]
    np.testing.assert_allclose(found.x[2], np.c_[source.obs[10:14], source.action[10:14]])
    last = trajectories[2].obs
    np.testing.assert_allclose(found.delta[0, 0], last[40] - last[39], atol=1e-6)


def test_an_epoch_sees_as_many_transitions_as_there_are():
    data, _ = toy_data([1.0, 2.0, 0.5])
    state = FitState.new(tiny_net())
    stats = fit(state, setup_of(), data)[1]
    assert (int(stats.updates), int(stats.skipped)) == (120 // 64, 0)
    stats = fit(state, setup_of(batch_size=10_000), data)[1]
    assert int(stats.updates) == 1


def test_adapting_lowers_the_error_under_physics_that_were_never_seen():
    data, _ = toy_data([0.5, 1.0, 1.5, 2.0])
    setup = setup_of(learning_rate=1e-2)
    state = FitState.new(tiny_net(sizes=(32, 32)))
    for epoch in range(150):
        state, _ = fit(state, setup, data, epoch, length=8, rate=0.1)

    @jax.jit
    def errors(transitions):
        whole = Window.of(setup.task, data.statistics, transitions, jnp.ones(16))
        past, future = (Window(*(x[part] for x in whole)) for part in (slice(8), slice(8, 16)))
        adapted = adapt(state.model, past, 0.1)
        return squared_error(state.model, future), squared_error(adapted, future)

    for gain in (0.25, 1.25):
        new = [toys.random_trajectory(16, seed=90 + i, gain=gain) for i in range(5)]
        found = [errors((jnp.asarray(t.obs[:-1]), t.action, jnp.asarray(t.obs[1:]))) for t in new]
        before, after = np.mean(found, axis=0)
        assert after < 0.85 * before
