"""Multi-headed networks, their contexts and their normalisers, against NumPy twins."""

import dataclasses

import jax.numpy as jnp
import numpy as np
import pytest

import toys
from headway.data import Episodes, History
from headway.errors import ConfigError
from headway.models.statistics import Statistics, network_input

TASK = toys.ScaledTask()
NAMES = ("gain", "drag")
PLACES = {"input": 0, "last-hidden": 2, "head": 3}
DEEP = dataclasses.replace(toys.SMALL, hidden_sizes=(8, 6, 5))


def random_input(members=2, batch=5, seed=0):
    """Observations, actions, histories and simulator parameters."""
    rng = np.random.default_rng(seed)
    draw = lambda *shape: jnp.asarray(rng.normal(size=shape), jnp.float32)  # noqa: E731
    history = History(draw(members, batch, 3, 2), draw(members, batch, 3, 2))
    return draw(members, batch, 2), draw(members, batch, 2), history, draw(members, batch, 2)


def input_twin(statistics, obs, action):
    features = np.concatenate([obs[..., :1], np.sin(obs[..., 1:]), np.cos(obs[..., 1:])], -1)
    features = (features - statistics.features.mean) / statistics.features.std
    return np.concatenate([features, (action - statistics.action.mean) / statistics.action.std], -1)


def history_twin(statistics, history):
    past = (history.action - statistics.history_action.mean) / statistics.history_action.std
    shape = (*past.shape[:2], -1)
    return np.concatenate([history.obs_diff.reshape(shape), past.reshape(shape)], -1)


def encoder_twin(encoder, flat):
    found = []
    for m, c in enumerate(flat):
        for layer in encoder.hidden:
            c = np.maximum(c @ layer.weight[m] + layer.bias[m], 0)  # noqa: PLW2901
        found.append(c @ encoder.output.weight[m] + encoder.output.bias[m])
    return np.stack(found)


def net_twin(net, x, context, place):
    """Mean and log-variance of every head, [member, head, sample, obs], sample by sample."""
    shape = net.mean_heads.weight.shape[:2] + x.shape[1:2] + net.mean_heads.bias.shape[-1:]
    mean, logvar = np.zeros(shape), np.zeros(shape)
    for m, h, i in np.ndindex(shape[:3]):
        values = x[m, i]
        for index, layer in enumerate(net.hidden):
            if index == place:
                values = np.concatenate([values, context[m, i]])
            values = values @ layer.weight[m] + layer.bias[m]
            values = values * toys.sigmoid(values)
        if place == len(net.hidden):
            values = np.concatenate([values, context[m, i]])
        mean[m, h, i] = values @ net.mean_heads.weight[m, h] + net.mean_heads.bias[m, h]
        raw = values @ net.logvar_heads.weight[m, h] + net.logvar_heads.bias[m, h]
        squeezed = net.max_logvar[h] - toys.softplus(net.max_logvar[h] - raw)
        logvar[m, h, i] = net.min_logvar[h] + toys.softplus(squeezed - net.min_logvar[h])
    return mean, logvar


@pytest.mark.parametrize("place", PLACES)
def test_predictions_of_every_member_head_and_sample_equal_their_numpy_twins(place):
    config = dataclasses.replace(DEEP, context_at=place)
    model, statistics = toys.small_model(task=TASK, config=config), toys.odd_statistics(TASK)
    obs, action, history, _ = random_input()
    context = model.context(history, statistics)
    exact, inputs = toys.f64((model, statistics)), toys.f64((obs, action, history))
    flat = history_twin(exact[1], inputs[2])
    told = encoder_twin(exact[0].context_encoder, flat)
    np.testing.assert_allclose(context, told, rtol=1e-3, atol=1e-4)
    x, x_twin = network_input(TASK, statistics, obs, action), input_twin(exact[1], *inputs[:2])
    for name in ("forward_net", "backward_net"):
        got = toys.predict(getattr(model, name), x, context)
        mean, logvar = net_twin(getattr(exact[0], name), x_twin, told, PLACES[place])
        np.testing.assert_allclose(got.mean, mean, rtol=1e-3, atol=1e-4)
        np.testing.assert_allclose(got.logvar, logvar, rtol=1e-3, atol=1e-4)


@pytest.mark.parametrize("kind", ["history", "sim-params"])
def test_each_kind_of_context_has_its_values(kind):
    model = toys.small_model(config=dataclasses.replace(toys.SMALL, context=kind))
    statistics = toys.odd_statistics(sim_param_names=NAMES)
    *_, history, sim_params = random_input()
    context = model.context(history, statistics, sim_params)
    assert model.context_encoder is None
    physics = statistics.sim_params
    expected = {
        "history": history_twin(statistics, history),
        "sim-params": (sim_params - physics.mean) / physics.std,
    }[kind]
    np.testing.assert_allclose(context, expected, rtol=1e-5)


def test_statistics_equal_their_numpy_twins_over_ragged_episodes():
    trajectories = [toys.random_trajectory(n, seed=n) for n in (1, 6, 4)]
    statistics = Statistics.fit(TASK, trajectories, 3)
    obs = np.concatenate([t.obs[:-1] for t in trajectories]).astype(np.float64)
    delta = np.concatenate([np.diff(t.obs, axis=0) for t in trajectories]).astype(np.float64)
    features = np.concatenate([obs[:, :1], np.sin(obs[:, 1:]), np.cos(obs[:, 1:])], -1)
    pairs = {
        "features": features,
        "action": np.concatenate([t.action for t in trajectories]).astype(np.float64),
        "delta": delta,
        "backward_delta": -delta,
    }
    for name, values in pairs.items():
        normalizer = getattr(statistics, name)
        np.testing.assert_allclose(normalizer.mean, values.mean(0), rtol=1e-5, atol=1e-6)
        np.testing.assert_allclose(normalizer.std, values.std(0), rtol=1e-5, atol=1e-6)
    assert statistics.history_action.mean.shape == (3, 2)
    assert statistics.sim_params is None


def test_simulator_parameters_are_normalised_over_all_transitions():
    lengths, gains = (1, 6, 4), (0.5, 2.0, -1.0)
    trajectories = [
        dataclasses.replace(toys.random_trajectory(n), sim_params={"drag": 0.25, "gain": g, "x": 7})
        for n, g in zip(lengths, gains, strict=True)
    ]
    found = Statistics.fit(toys.POINT, trajectories, 3, NAMES).sim_params
    per_transition = np.repeat(gains, lengths)
    np.testing.assert_allclose(found.mean, [per_transition.mean(), 0.25], rtol=1e-6)
    np.testing.assert_allclose(found.std, [per_transition.std(), 0.0], rtol=1e-6)
    np.testing.assert_allclose(found.normalize(jnp.array([0.0, 0.35]))[1], 0.1, rtol=1e-5)


def test_episodes_carry_the_parameters_that_a_model_is_told_and_no_others():
    trajectories = [toys.random_trajectory(3, gain=g) for g in (0.5, -2.0)]
    padded = Episodes.pad(trajectories, 3, 5, ("gain",))
    np.testing.assert_array_equal(padded.sim_params, [[0.5], [-2.0], [0.0]])
    assert Episodes.pad(trajectories, 3, 5).sim_params.shape == (3, 0)
    with pytest.raises(ConfigError, match="lack drag, allowed: a finite number for each of gain"):
        Episodes.pad(trajectories, 3, 5, NAMES)
