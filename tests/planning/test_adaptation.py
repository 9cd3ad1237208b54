"""Agents whose heads keep learning: what they learn, drop, select and plan with."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import toys
from headway.errors import ConfigError
from headway.models.last_layer import Prior

LAST_LAYER = dataclasses.replace(toys.TINY, selection_length=3, adaptation="last-layer")

# With an agent. One wrong head, whose gain the episode teaches: the toy model is linear, so its
# features x and -x suffice.
WRONG = toys.linear_model([[0.4 * np.eye(2), -np.eye(2)], [0.3 * np.eye(2), -np.eye(2)]])


def even_prior(model, ratio=1e4, noise=1e-4):
    """All weights are equally uncertain."""
    size = model.forward_net.mean_heads.weight.shape[2] + 1
    root = jnp.broadcast_to(np.sqrt(ratio) * jnp.eye(size), (2, size, size))
    return Prior(root, jnp.full((2, 2), noise))


def make_agent(model=WRONG, prior=None, **settings):
    prior = even_prior(model) if prior is None else prior
    return toys.make_agent(model, LAST_LAYER, prior=prior, **settings)


def play(agent, gain, steps, *, state=None, spike=None, first_random=0):
    """Act on `obs' = obs + gain * push`, the push being the action and some noise."""
    rng = np.random.default_rng(0)
    state = agent.init(2, key=jax.random.key(0)) if state is None else state
    decisions, obs = [], np.float32([[0.8, -0.6], [0.5, 0.5]])
    for step in range(steps):
        state, decision = agent.act(state, obs if spike is None or step != 3 else spike)
        decisions.append(decision)
        push = np.asarray(decision.action) * (step >= first_random) + rng.uniform(-0.5, 0.5, (2, 2))
        state = state._replace(action=jnp.asarray(push, jnp.float32))
        obs = (obs + gain * push).astype(np.float32)
    return state, decisions


def predicted_gain(agent, state):
    """What the chosen head now says that a push of 1 does, per env and member."""
    weight = (
        agent.model.net.forward_net.mean_heads.weight + state.belief.last_layer.weight[..., :-1, :]
    )
    obs_size = agent.task.obs_size
    size = obs_size + agent.task.action_size
    slope = 0.5 * (weight[:, :, 0, obs_size] - weight[:, :, 0, size + obs_size])
    return np.asarray(slope)[..., 0]


def test_the_heads_learn_the_episodes_physics_and_forget_them_with_it():
    agent = make_agent()
    state, _ = play(agent, 1.0, 15, first_random=15)
    np.testing.assert_allclose(predicted_gain(agent, state), 1.0, atol=0.05)
    start = agent.init(2, key=jax.random.key(1))
    reset = toys.reset_where(state, start, jnp.asarray([True, False]))
    np.testing.assert_allclose(predicted_gain(agent, reset)[0], [0.4, 0.3], atol=1e-6)
    np.testing.assert_allclose(predicted_gain(agent, reset)[1], 1.0, atol=0.05)
    np.testing.assert_array_equal(reset.belief.last_layer.root[0], start.belief.last_layer.root[0])


def test_plans_use_what_was_learned():
    """The head says that pushing does the opposite; only a corrected plan approaches zero."""
    opposite = toys.linear_model([[-0.5 * np.eye(2)] * 2] * 2)
    ends = {}
    for adaptation in ("none", "last-layer"):
        agent = make_agent(opposite, adaptation=adaptation)
        state, _ = play(agent, 0.4, 25, first_random=10)
        ends[adaptation] = np.abs(np.asarray(state.belief.recent.next_obs[:, -1])).max()
    assert ends["last-layer"] < 0.6
    assert ends["none"] > 2.0


def test_without_anything_to_learn_actions_are_those_of_frozen_heads():
    zero = even_prior(WRONG, ratio=0.0)
    frozen, _ = play(make_agent(adaptation="none"), 1.0, 4)
    learning_nothing, _ = play(make_agent(prior=zero), 1.0, 4)
    # With the flags of conftest.py XLA compiles the two programs to other last bits.
    np.testing.assert_allclose(learning_nothing.search.nominal, frozen.search.nominal, atol=1e-6)


@pytest.mark.parametrize("value", [1e4, 1e18, 1e30, np.inf, np.nan])
@pytest.mark.parametrize("settings", [{}, {"change_threshold": 10.0}], ids=str)
def test_absurd_observations_give_finite_actions_and_are_not_learned(value, settings):
    agent = make_agent(toys.small_model(), **settings)
    spike = np.full((2, 2), value, np.float32)
    state, decisions = play(agent, 1.0, 8, spike=spike)
    toys.assert_finite([[decision.action for decision in decisions], state.belief.last_layer])
    assert np.abs(state.belief.last_layer.weight).max() < 1e3


def test_changed_physics_are_noticed_and_what_was_learned_is_dropped():
    errors = {}
    for threshold in (0.0, 10.0):
        agent = make_agent(change_threshold=threshold)
        before, _ = play(agent, 1.0, 15, first_random=15)
        state = before._replace(acted=jnp.zeros(2, bool))  # the two parts do not meet
        after, _ = play(agent, -0.2, 12, state=state, first_random=12)
        errors[threshold] = np.abs(predicted_gain(agent, after) + 0.2).max()
        if threshold:
            assert (np.asarray(before.belief.last_layer.cusum) < threshold).all()
    assert errors[10.0] < 0.05
    assert errors[10.0] < 0.5 * errors[0.0]


def by_chance(agent, gain, steps, *, state, glitches=()):
    """Random pushes; at some steps the first environment is moved by something else as well."""
    rng = np.random.default_rng(3)
    obs = np.asarray(state.obs)
    layers = []
    for step in range(steps):
        state = state._replace(action=jnp.asarray(rng.uniform(-0.5, 0.5, (2, 2)), jnp.float32))
        obs = obs + gain * np.asarray(state.action)
        obs[0] += 3.0 * (step in glitches)
        state, _ = agent.act(state, obs.astype(np.float32))
        layers.append(state.belief.last_layer)
    return state, layers


def test_one_glitch_is_no_change_and_teaches_next_to_nothing():
    taught = {}
    for threshold in (0.0, 20.0):
        agent = make_agent(change_threshold=threshold)
        state, _ = play(agent, 1.0, 15, first_random=15)
        state, (_, before, after) = by_chance(agent, 1.0, 3, state=state, glitches=[2])
        taught[threshold] = np.abs(after.weight[0] - before.weight[0]).max()
        np.testing.assert_array_equal(after.count - before.count, 1)  # nothing was dropped
        np.testing.assert_allclose(predicted_gain(agent, state)[1], 1.0, atol=0.01)
    assert taught[20.0] < 1e-3 * taught[0.0]
    np.testing.assert_allclose(predicted_gain(agent, state)[0], 1.0, atol=1e-3)


def test_a_change_is_noticed_after_a_glitch_and_only_where_it_happens():
    """The physics of the first environment changes, and of the second it does not."""
    agent = make_agent(change_threshold=20.0)
    state, _ = play(agent, 1.0, 15, first_random=15)
    state, _ = by_chance(agent, 1.0, 8, state=state, glitches=[2])
    assert (np.asarray(state.belief.last_layer.cusum) == 0).all()
    gains = np.float32([[-0.2], [1.0]])
    state, layers = by_chance(agent, gains, 12, state=state)
    counts = np.asarray([layer.count for layer in layers])[..., 0]
    assert (np.diff(counts[:, 0]) < 0).sum() == 1
    assert (np.diff(counts[:, 1]) == 1).all()
    np.testing.assert_allclose(predicted_gain(agent, state)[0], -0.2, atol=0.05)
    np.testing.assert_allclose(predicted_gain(agent, state)[1], 1.0, atol=0.05)


def test_errors_larger_than_in_training_are_not_taken_for_changes():
    """Noise of a hundred times the training data's, throughout the episode."""
    quiet = even_prior(WRONG, 10.0, 1e-6)
    agent = make_agent(prior=quiet, change_threshold=20.0)
    rng = np.random.default_rng(1)
    state, _ = play(agent, 1.0, 8, first_random=8)
    for _ in range(20):
        obs = np.asarray(state.belief.recent.next_obs[:, -1]) + rng.normal(size=(2, 2), scale=0.1)
        state, _ = agent.act(state, obs.astype(np.float32))
        state = state._replace(action=jnp.asarray(rng.uniform(-0.5, 0.5, (2, 2)), jnp.float32))
    assert (np.asarray(state.belief.last_layer.count) > 20).all()


def test_an_agent_needs_a_prior_to_adapt():
    with pytest.raises(ConfigError, match="fit_prior"):
        toys.make_agent(WRONG, LAST_LAYER)
