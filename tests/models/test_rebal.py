"""ReBAL's network against a NumPy twin; its truncated gradient; learning what only memory shows."""

import jax
import jax.numpy as jnp
import numpy as np
from adaptive_helpers import random_window, toy_data

import toys
from headway.config import RecurrentConfig
from headway.models.fitting import FitState
from headway.models.grbal import Window
from headway.models.rebal import RecurrentNet, batch_gradient, recurrent_epoch

truncated = jax.jit(batch_gradient, static_argnums=2)


def tiny_net(seed=0, sizes=(3, 4)):
    config = RecurrentConfig(hidden_sizes=sizes)
    net = RecurrentNet.init(config, toys.POINT, key=jax.random.key(seed))
    rng = np.random.default_rng(seed)
    return jax.tree.map(lambda x: x + 0.1 * jnp.asarray(rng.normal(size=x.shape), x.dtype), net)


def twin_rollout(net, xs):
    """Predictions of one sequence, one unit at a time, in NumPy's float64."""
    net = toys.f64(net)
    hidden = [np.zeros(m) for m in net.sizes]
    cell = [np.zeros(m) for m in net.sizes]
    found = []
    for features in np.asarray(xs, np.float64):
        x = features
        for i, layer in enumerate(net.layers):
            joined, size = np.concatenate([x, hidden[i]]), net.sizes[i]
            gates = joined @ layer.weight[0] + layer.bias[0]
            for unit in range(size):
                let_in, keep, new, let_out = gates[unit::size]
                cell[i][unit] = toys.sigmoid(keep) * cell[i][unit] + toys.sigmoid(let_in) * np.tanh(
                    new
                )
                hidden[i][unit] = toys.sigmoid(let_out) * np.tanh(cell[i][unit])
            x = hidden[i]
        found.append(x @ net.output.weight[0] + net.output.bias[0])
    return np.array(found)


def test_steps_equal_a_numpy_twin():
    net, xs = tiny_net(), random_window(3, 5, 7).x
    expected = [twin_rollout(net, sequence) for sequence in xs]
    np.testing.assert_allclose(rollout(net, xs), expected, rtol=1e-4, atol=1e-6)


@jax.jit
def whole_loss(net, batch):
    errors = jnp.square(rollout(net, batch.x) - batch.delta).mean(-1)
    return (batch.weight * errors).sum() / batch.weight.sum()


def rollout(net, xs, state=None):
    """Predictions of whole sequences [episode, step, in]; the state from zero by default."""
    state = net.start(len(xs)) if state is None else state
    return go_through(net, state, xs)[1].swapaxes(0, 1)


def go_through(net, state, xs):
    def step(state, x):
        return net(state, x)

    return jax.lax.scan(step, state, xs.swapaxes(0, 1))


def test_an_untruncated_gradient_is_that_of_the_whole_error_whatever_the_padding():
    net, batch = tiny_net(), random_window(4, 2, 7)
    loss, grads = truncated(net, batch, 7)
    expected, expected_grads = jax.jit(jax.value_and_grad(whole_loss))(net, batch)
    np.testing.assert_allclose(loss, expected, rtol=1e-5)
    toys.assert_close(grads, expected_grads)
    np.testing.assert_allclose(truncated(net, batch, 9)[0], expected, rtol=1e-5)


def test_a_truncated_gradient_stops_between_chunks_but_the_state_goes_on():
    net, batch = tiny_net(), random_window(4, 2, 8)
    loss, grads = truncated(net, batch, 4)
    np.testing.assert_allclose(loss, whole_loss(net, batch), rtol=1e-5)

    def second_half(net):
        """The error of the second chunk alone, from the state that the first one ends with."""
        state, _ = go_through(net, net.start(2), batch.x[:, :4])
        predicted = rollout(net, batch.x[:, 4:], jax.lax.stop_gradient(state))
        errors = jnp.square(predicted - batch.delta[:, 4:]).mean(-1)
        return (batch.weight[:, 4:] * errors).sum() / batch.weight.sum()

    first = Window(*(x[:, :4] for x in batch))
    share = first.weight.sum() / batch.weight.sum()
    halves = jax.jit(jax.grad(second_half))(net), truncated(net, first, 4)[1]
    expected = jax.tree.map(lambda a, b: a + share * b, *halves)
    toys.assert_close(grads, expected)


def test_an_epoch_shows_every_episode_once_in_batches_of_whole_ones():
    data, _ = toy_data([1.0, 2.0, 0.5], steps=10)  # laid out in arrays of 13 steps
    state = FitState.new(tiny_net())
    updates = []
    for batch_size in (1, 26, 1000):
        setup = toys.make_setup(1, batch_size=batch_size, backprop_steps=5)
        stats = recurrent_epoch(state, setup, data, key=jax.random.key(0))[1]
        updates.append(int(stats.updates))
    assert updates == [3, 2, 1]
    obs, action = data.episodes.obs[:3], data.episodes.action[:3]
    weight = (jnp.arange(13) < 10).astype(jnp.float32) * jnp.ones((3, 1))
    transitions = obs[:, :-1], action, obs[:, 1:]
    batch = Window.of(toys.POINT, data.statistics, transitions, weight)
    np.testing.assert_allclose(stats.loss, whole_loss(tiny_net(), batch), rtol=1e-5)


def test_memory_tells_physics_apart():
    data, trajectories = toy_data([0.5, 1.0, 1.5, 2.0], steps=24)
    setup = toys.make_setup(1, batch_size=54, backprop_steps=12, learning_rate=1e-2)
    config = RecurrentConfig(hidden_sizes=(24,))
    net = RecurrentNet.init(config, toys.POINT, key=jax.random.key(0))
    state = FitState.new(net)
    for epoch in range(120):
        state, _ = recurrent_epoch(state, setup, data, key=jax.random.key(epoch))
    errors = []
    for trajectory in trajectories:
        xs = np.c_[trajectory.obs[:-1], trajectory.action].astype(np.float32)
        predicted = twin_rollout(state.model, xs)
        errors.append(np.square(predicted - np.diff(trajectory.obs, axis=0)).mean(-1))
    by_step = np.mean(errors, 0)
    # The first step cannot know the gain; later ones have seen what pushing does.
    assert by_step[8:].mean() < 0.4 * by_step[0]
