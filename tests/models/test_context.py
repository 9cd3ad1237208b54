"""The context and the layers that it joins: against plain NumPy."""

import dataclasses

import jax.numpy as jnp
import numpy as np
import pytest

import toys
from headway.data import Episodes, History
from headway.errors import ConfigError
from headway.models.multi_headed import Statistics, context_size

PLACES = ["input", "last-hidden", "head"]
KINDS = ["learned", "history", "sim-params"]
NAMES = ("gain", "drag")
DEEP = dataclasses.replace(toys.SMALL, hidden_sizes=(8, 6, 5))


def swish(x):
    return x / (1 + np.exp(-x))


def concatenating_twin(net, x, context, place):
    """Mean of every head, with the context appended to what one layer takes."""
    place = {"input": 0, "last-hidden": len(net.hidden) - 1, "head": len(net.hidden)}[place]
    out = np.zeros((*net.mean_heads.weight.shape[:2], x.shape[1], net.mean_heads.bias.shape[-1]))
    for m, h, i in np.ndindex(out.shape[:3]):
        values = x[m, i]
        for index, layer in enumerate(net.hidden):
            if index == place:
                values = np.concatenate([values, context[m, i]])
            values = swish(values @ layer.weight[m] + layer.bias[m])
        if place == len(net.hidden):
            values = np.concatenate([values, context[m, i]])
        out[m, h, i] = values @ net.mean_heads.weight[m, h] + net.mean_heads.bias[m, h]
    return out


@pytest.mark.parametrize("place", PLACES)
def test_a_context_is_appended_to_what_its_layer_takes(place):
    model = toys.small_model(config=dataclasses.replace(DEEP, context_at=place))
    rng = np.random.default_rng(0)
    x, context = rng.normal(size=(2, 5, 4)), rng.normal(size=(2, 5, 3))
    for net in (model.forward_net, model.backward_net):
        got = net(jnp.asarray(x, jnp.float32), jnp.asarray(context, jnp.float32))
        expected = concatenating_twin(toys.f64(net), x, context, place)
        np.testing.assert_allclose(got.mean, expected, rtol=1e-4, atol=1e-5)


def told_history(members=2, batch=4, seed=0):
    rng = np.random.default_rng(seed)
    past = History(*jnp.asarray(rng.normal(size=(2, members, batch, 3, 2)), jnp.float32))
    return past, jnp.asarray(rng.normal(size=(members, batch, 2)), jnp.float32)


@pytest.mark.parametrize("place", PLACES)
@pytest.mark.parametrize("kind", KINDS)
def test_each_kind_of_context_has_its_width_and_its_values(kind, place):
    config = dataclasses.replace(toys.SMALL, context=kind, context_at=place)
    model = toys.small_model(config=config)
    statistics = toys.odd_statistics(sim_param_names=NAMES)
    history, sim_params = told_history()
    context = np.asarray(model.context(history, statistics, sim_params))
    assert context.shape == (2, 4, context_size(config, toys.POINT, 2))
    assert (model.context_encoder is not None) == (kind == "learned")
    if kind == "sim-params":
        physics = statistics.sim_params
        np.testing.assert_allclose(context, (sim_params - physics.mean) / physics.std, rtol=1e-5)
    if kind == "history":
        past = statistics.history_action
        action = (history.action - past.mean) / past.std
        flat = [np.reshape(part, (2, 4, 6)) for part in (history.obs_diff, action)]
        np.testing.assert_allclose(context, np.concatenate(flat, -1), rtol=1e-5)


def test_a_learned_context_of_no_width_is_none():
    model = toys.small_model(config=dataclasses.replace(toys.SMALL, context_size=0))
    assert model.context(told_history()[0], toys.odd_statistics()) is None


def test_simulator_parameters_are_normalised_over_all_transitions():
    lengths, gains = (1, 6, 4), (0.5, 2.0, -1.0)
    trajectories = [toys.random_trajectory(n, gain=g) for n, g in zip(lengths, gains, strict=True)]
    told = [
        dataclasses.replace(t, sim_params={"drag": 0.25, "unused": 7.0, **t.sim_params})
        for t in trajectories
    ]
    found = Statistics.fit(toys.POINT, told, 3, NAMES).sim_params
    per_transition = np.repeat(gains, lengths)
    np.testing.assert_allclose(found.mean, [per_transition.mean(), 0.25], rtol=1e-6)
    np.testing.assert_allclose(found.std, [per_transition.std(), 0.0], rtol=1e-6)
    np.testing.assert_allclose(found.normalize(jnp.array([0.0, 0.35]))[1], 0.1, rtol=1e-5)
    assert Statistics.fit(toys.POINT, told, 3).sim_params is None


def test_episodes_carry_the_parameters_that_a_model_is_told_and_no_others():
    trajectories = [toys.random_trajectory(3, gain=g) for g in (0.5, -2.0)]
    padded = Episodes.pad(trajectories, 3, 5, ("gain",))
    np.testing.assert_array_equal(padded.sim_params, [[0.5], [-2.0], [0.0]])
    assert Episodes.pad(trajectories, 3, 5).sim_params.shape == (3, 0)
    with pytest.raises(ConfigError, match="lack drag, allowed: a value for each of gain, drag"):
        Episodes.pad(trajectories, 3, 5, NAMES)
