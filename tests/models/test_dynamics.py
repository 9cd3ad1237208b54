"""The whole model against a NumPy twin, its switches, and its normalisers."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import toys
from headway.data import History
from headway.models.multi_headed import MultiHeadDynamics, Statistics, network_input

TASK = toys.ScaledTask()
SWITCHES = [{}, {"context_size": 0}, {"backward_net": False}, {"deterministic": True}]


def random_input(members=2, batch=5, seed=0):
    rng = np.random.default_rng(seed)
    draw = lambda *shape: jnp.asarray(rng.normal(size=shape), jnp.float32)  # noqa: E731
    history = History(draw(members, batch, 3, 2), draw(members, batch, 3, 2))
    return draw(members, batch, 2), draw(members, batch, 2), history


def twin(model, statistics, obs, action, history):
    """Mean and log-variance of every head, [member, head, sample, obs], one by one."""
    net, encoder = model.forward_net, model.context_encoder
    features = np.concatenate([obs[..., :1], np.sin(obs[..., 1:]), np.cos(obs[..., 1:])], -1)
    features = (features - statistics.features.mean) / statistics.features.std
    scaled = (action - statistics.action.mean) / statistics.action.std
    past = (history.action - statistics.history_action.mean) / statistics.history_action.std
    shape = net.mean_heads.weight.shape[:2] + obs.shape[1:2] + obs.shape[-1:]
    mean, logvar = np.zeros(shape), np.zeros(shape)
    for m, h, i in np.ndindex(shape[:3]):
        c = np.concatenate([history.obs_diff[m, i].ravel(), past[m, i].ravel()])
        for layer in encoder.hidden:
            c = np.maximum(c @ layer.weight[m] + layer.bias[m], 0)
        c = c @ encoder.output.weight[m] + encoder.output.bias[m]
        x = np.concatenate([features[m, i], scaled[m, i]])
        for layer in net.hidden:
            x = x @ layer.weight[m] + layer.bias[m]
            x = x / (1 + np.exp(-x))
        x = np.concatenate([x, c])
        mean[m, h, i] = x @ net.mean_heads.weight[m, h] + net.mean_heads.bias[m, h]
        raw = x @ net.logvar_heads.weight[m, h] + net.logvar_heads.bias[m, h]
        squeezed = net.max_logvar[h] - toys.softplus(net.max_logvar[h] - raw)
        logvar[m, h, i] = net.min_logvar[h] + toys.softplus(squeezed - net.min_logvar[h])
    return mean, logvar


def test_prediction_of_every_member_head_and_sample_equals_its_numpy_twin():
    model, statistics = toys.small_model(task=TASK), toys.odd_statistics(TASK)
    obs, action, history = random_input()
    context = model.context(history, statistics)
    got = model.forward_net(network_input(TASK, statistics, obs, action), context)
    mean, logvar = twin(*map(toys.f64, (model, statistics, obs, action, history)))
    np.testing.assert_allclose(got.mean, mean, rtol=1e-3, atol=1e-4)
    np.testing.assert_allclose(got.logvar, logvar, rtol=1e-3, atol=1e-4)


@pytest.mark.parametrize("switches", SWITCHES, ids=str)
def test_every_switch_of_the_model_builds_and_predicts(switches):
    config = dataclasses.replace(toys.SMALL, **switches)
    model = MultiHeadDynamics.init(config, TASK, key=jax.random.key(0))
    statistics = Statistics.identity(TASK, config.history_length)
    obs, action, history = random_input()
    context = model.context(history, statistics)
    x = network_input(TASK, statistics, obs, action)
    prediction = model.forward_net(x, context)
    assert prediction.mean.shape == (2, 2, 5, 2)
    assert (context is None) == (config.context_size == 0)
    assert (model.backward_net is None) == (not config.backward_net)
    assert (prediction.logvar is None) == config.deterministic
    assert (model.num_members, model.num_heads) == (2, 2)
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(prediction))


def test_statistics_equal_their_numpy_twins_over_ragged_episodes():
    trajectories = [toys.random_trajectory(n, seed=n) for n in (1, 6, 4)]
    statistics = Statistics.fit(TASK, trajectories, 3)
    obs = np.concatenate([t.obs[:-1] for t in trajectories]).astype(np.float64)
    delta = np.concatenate([np.diff(t.obs, axis=0) for t in trajectories]).astype(np.float64)
    action = np.concatenate([t.action for t in trajectories]).astype(np.float64)
    features = np.concatenate([obs[:, :1], np.sin(obs[:, 1:]), np.cos(obs[:, 1:])], -1)
    pairs = [
        (statistics.features, features),
        (statistics.action, action),
        (statistics.delta, delta),
        (statistics.backward_delta, -delta),
    ]
    for normalizer, values in pairs:
        np.testing.assert_allclose(normalizer.mean, values.mean(0), rtol=1e-5, atol=1e-6)
        np.testing.assert_allclose(normalizer.std, values.std(0), rtol=1e-5, atol=1e-6)
    assert statistics.history_action.mean.shape == (3, 2)
