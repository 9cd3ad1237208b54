"""Which head plans: the best on the last N transitions; and the networks folded for a plan."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import toys
from headway.config import PlannerConfig
from headway.errors import ConfigError
from headway.models.base import RecentTransitions, Transition
from headway.models.folding import fold
from headway.models.multi_headed import MultiHeadModel, MultiHeadNet, select_heads
from headway.models.statistics import Normalizer, network_input
from headway.planning.controller import Controller

UP, DOWN = 1.0, -1.0
UP_HEADS, DOWN_HEADS = [0, 1], [1, 0]  # the heads of the two members that know each physics
SLOTS = 6
YES = jnp.asarray([True])


def model_of(net=toys.UP_DOWN, *, statistics=None, task=toys.POINT, planner=None):
    statistics = statistics or toys.identity_statistics(task)
    return MultiHeadModel(net, statistics, task, planner or PlannerConfig(), 3)


def remember(pushes, *, num_slots=SLOTS):
    """The transitions of one environment whose pushes went up or down, by any size."""
    rng = np.random.default_rng(0)
    recent = RecentTransitions.empty(1, num_slots, toys.POINT)
    obs = jnp.zeros((1, 2))
    for push in pushes:
        action = jnp.asarray(rng.uniform(0.5, 1, (1, 2)), jnp.float32)
        recent = recent.push(Transition(obs, action, obs + push * action, YES))
        obs = obs + push * action
    return recent


@eqx.filter_jit
def chosen(model, recent, keys):
    return model.choose_heads(recent, None, keys)


def choose(pushes, *, net=toys.UP_DOWN, statistics=None, key=0, **settings):
    model = model_of(net, statistics=statistics, planner=PlannerConfig(**settings))
    keys = jnp.stack([jax.random.key(key), jax.random.key(7)])
    return chosen(model, remember(pushes), keys)[0].tolist()


def spread_over_keys(pushes, **settings):
    return {tuple(choose(pushes, key=key, **settings)) for key in range(30)}


@pytest.mark.parametrize(
    ("pushes", "length", "skips", "expected"),
    [
        ([UP] * 5 + [DOWN], 1, False, DOWN_HEADS),
        ([-9.0, UP, UP, UP], 3, False, UP_HEADS),
        ([-9.0, UP, UP, UP], 4, False, DOWN_HEADS),
        ([UP], 5, False, UP_HEADS),
        ([-9.0] + [UP] * 6, 6, False, UP_HEADS),
        ([-9.0, UP, UP, -9.0], 3, True, UP_HEADS),  # the two before the newest
        ([-9.0, UP, UP, -9.0], 4, True, DOWN_HEADS),
        ([UP, -9.0], 6, True, UP_HEADS),
    ],
)
def test_each_member_takes_the_head_that_is_best_on_the_last_n_and_no_older(
    pushes, length, skips, expected
):
    found = choose(pushes, selection_length=length, selection_skips_newest=skips)
    assert found == expected


def test_head_is_random_per_member_when_nothing_that_counts_is_remembered():
    length = {"selection_length": SLOTS}
    assert spread_over_keys([], **length) == {(0, 0), (0, 1), (1, 0), (1, 1)}
    assert len(spread_over_keys([UP], selection_skips_newest=True, **length)) == 4
    both = spread_over_keys([UP, UP], selection_skips_newest=True, **length)
    assert both == spread_over_keys([UP], **length) == {tuple(UP_HEADS)}


def noisy_heads(gains, stds):
    """One member whose heads have known gains and noise."""
    net = toys.linear_model([gains]).forward_net
    return MultiHeadNet(toys.with_noise(net, stds), None, None)


def test_sampled_error_is_squared_bias_plus_variance_and_the_mean_error_is_bias_alone():
    net = noisy_heads([1.2 * np.eye(2), np.eye(2)], [1e-6, 0.5])
    recent = remember([UP] * SLOTS)
    plain = model_of(net).head_errors(recent[:3], None)
    sampled = model_of(net).head_errors(recent[:3], None, sampling_key=jax.random.key(0))
    assert plain.shape == sampled.shape == (1, 1, 2, SLOTS)
    bias = np.square(0.2 * np.asarray(recent.action[0])).mean(-1)
    np.testing.assert_allclose(plain[0, 0], [bias, np.zeros(SLOTS)], atol=1e-5)
    np.testing.assert_allclose(sampled[0, 0, 0], bias, rtol=1e-3)
    np.testing.assert_allclose(sampled[0, 0, 1], 0.25, rtol=0.6)
    np.testing.assert_allclose(sampled[0, 0, 1].mean(), 0.25, rtol=0.2)
    settings = {"net": net, "selection_length": SLOTS}
    assert choose([UP] * SLOTS, **settings) == [1]
    assert choose([UP] * SLOTS, selection_error="sampled", **settings) == [0]


def test_mean_error_is_in_normalised_and_sampled_error_in_raw_units():
    scale = Normalizer(jnp.zeros(2), jnp.asarray([1.0, 100.0]))
    statistics = dataclasses.replace(toys.identity_statistics(), delta=scale)
    settings = {"statistics": statistics, "selection_length": SLOTS}
    # The second dimension weighs little in normalised units.
    net = noisy_heads([np.diag([1.9, 0.01]), np.diag([1.0, 0.03])], [1e-6, 1e-6])
    assert choose([UP], net=net, **settings) == [1]
    assert choose([UP], net=net, selection_error="sampled", **settings) == [0]


def test_a_non_finite_error_never_wins_and_unused_slots_do_not_count():
    errors = jnp.asarray([[[[jnp.nan, 1.0], [0.0, 9.0], [0.0, jnp.inf]]]])
    key = jax.random.key(0)
    newest_only, both = jnp.asarray([[False, True]]), jnp.asarray([[True, True]])
    assert select_heads(errors, newest_only, key=key).tolist() == [[0]]
    assert select_heads(errors, both, key=key).tolist() == [[1]]


@pytest.mark.parametrize(("length", "num_slots"), [(1, 8), (5, 8), (8, 8), (5, 11)])
def test_history_equals_that_of_the_same_episode_in_the_data_at_every_step(length, num_slots):
    trajectory = toys.random_trajectory(14)
    episodes, _ = toys.lay_out([trajectory])
    recent = RecentTransitions.empty(1, num_slots, toys.POINT)
    obs, action = jnp.asarray(trajectory.obs)[:, None], jnp.asarray(trajectory.action)[:, None]
    for step in range(14):
        expected = episodes.history(jnp.asarray([0]), jnp.asarray([step]), length)
        toys.assert_equal(recent.history(length), expected)
        recent = recent.push(Transition(obs[step], action[step], obs[step + 1], YES))


# Networks folded for a plan, with a context that joins them at any place.

TASK = toys.ScaledTask()
NAMES = ("gain", "drag")
CONFIG = dataclasses.replace(toys.SMALL, hidden_sizes=(8, 7, 6))
PLACES = ["input", "last-hidden", "head"]


def net_at(place, **settings):
    config = dataclasses.replace(CONFIG, context_at=place, **settings)
    return toys.small_model(task=TASK, config=config)


@pytest.mark.parametrize("place", [*PLACES, "nowhere"])
def test_folded_networks_predict_what_the_whole_ones_predict(place):
    net = net_at("head", context_size=0) if place == "nowhere" else net_at(place)
    statistics = toys.odd_statistics(TASK)
    rng = np.random.default_rng(0)
    obs, action, noise = jnp.asarray(rng.normal(size=(3, 2, 3, 4, 2)), jnp.float32)
    context = jnp.asarray(rng.normal(size=(2, 3, 3)), jnp.float32)
    context = None if place == "nowhere" else context
    for heads in (rng.integers(0, 2, (3, 2, 1)), np.tile([0, 1], (3, 2, 1))):
        dynamics = fold(net.forward_net, statistics, TASK, jnp.asarray(heads), context)
        for env in range(3):
            one = dynamics.of_env(jax.tree.map(lambda x, env=env: x[env], dynamics.own))
            wide = [x[:, env].mT[..., None] for x in (obs, action, noise)]  # one candidate
            inputs = network_input(TASK, statistics, obs[:, env], action[:, env])
            told = None if context is None else jnp.repeat(context[:, env, None], 4, axis=1)
            whole = toys.predict(net.forward_net, inputs, told)
            still, moved = (one.step((), *wide[:2], drawn)[1] for drawn in (None, wide[2]))
            for member, picked in enumerate(heads[env]):
                mean = statistics.delta.denormalize(whole.mean[member, picked]).mean(0)
                std = np.exp(0.5 * np.asarray(whole.logvar)[member, picked])
                std = np.sqrt((std**2).sum(0)) / len(picked) * statistics.delta.std
                for found, drawn in ((still, 0.0), (moved, noise[member, env])):
                    wanted = TASK.postprocess(obs[member, env], mean + drawn * std)
                    np.testing.assert_allclose(
                        found[member, ..., 0].T, wanted, rtol=1e-3, atol=3e-4
                    )


@pytest.mark.parametrize("place", PLACES)
def test_heads_compete_with_the_context_of_their_environment_and_member(place):
    net, statistics = net_at(place), toys.odd_statistics(TASK)
    rng = np.random.default_rng(2)
    obs, action, next_obs = jnp.asarray(rng.normal(size=(3, 3, 4, 2)), jnp.float32)
    context = jnp.asarray(rng.normal(size=(2, 3, 3)), jnp.float32)
    model = model_of(net, statistics=statistics, task=TASK)
    errors = model.head_errors((obs, action, next_obs), context)
    for env in range(3):
        x = network_input(TASK, statistics, obs[env], action[env])
        wide = jnp.repeat(context[:, env, None], 4, axis=1)
        mean = toys.predict(net.forward_net, jnp.broadcast_to(x, (2, *x.shape)), wide).mean
        delta = TASK.target(obs[env], next_obs[env])
        expected = jnp.square(mean - statistics.delta.normalize(delta)).mean(-1)
        np.testing.assert_allclose(errors[env], expected, rtol=1e-4, atol=1e-5)


def told_agent():
    net = net_at("input", context="sim-params", num_heads=1)
    statistics = toys.odd_statistics(TASK, sim_param_names=NAMES)
    return toys.make_agent(net, statistics=statistics, task=TASK)


def test_an_agent_that_is_told_the_physics_plans_with_them():
    agent, obs = told_agent(), np.ones((2, 2), np.float32)
    physics = [{"gain": 0.5, "drag": 1.0}, {"gain": -2.0, "drag": 1.0}]
    (one, first), (other, second) = (
        agent.act(agent.init(2, key=jax.random.key(0), sim_params=told), obs)
        for told in (physics, physics[::-1])
    )
    std, mean = agent.model.statistics.sim_params.std, agent.model.statistics.sim_params.mean
    expected = (np.array([[0.5, 1.0], [-2.0, 1.0]]) - mean) / std
    np.testing.assert_allclose(one.belief.context, [expected, expected], rtol=1e-5)
    np.testing.assert_allclose(other.belief.context, one.belief.context[:, ::-1], rtol=1e-6)
    assert not np.allclose(first.action, second.action, atol=1e-3)


def test_a_controller_that_was_not_told_the_physics_says_what_to_do():
    controller = Controller(told_agent())
    with pytest.raises(ConfigError, match=r"gain, drag.*reset\(sim_params="):
        controller.act(np.zeros(2))
    with pytest.raises(ConfigError, match="lack drag, allowed: a finite number for each of gain"):
        controller.reset(sim_params={"gain": 1.0})
    for wrong in ("slippery", None, float("nan"), [1.0]):
        with pytest.raises(ConfigError, match="lack drag, allowed: a finite number"):
            controller.reset(sim_params={"gain": 1.0, "drag": wrong})
    controller.reset(sim_params={"gain": 1.0, "drag": 0.0, "unused": 3.0})
    told = controller.act(np.zeros(2))
    controller.reset()
    with pytest.raises(ConfigError, match="told no sim_params"):
        controller.act(np.zeros(2))
    assert np.isfinite(told).all()


def test_other_controllers_take_no_notice_of_the_physics():
    agent = toys.make_agent(net_at("head"), task=TASK)
    first, second = Controller(agent), Controller(agent)
    first.reset(sim_params={"gain": 1.0})
    second.reset()
    np.testing.assert_array_equal(first.act(np.ones(2)), second.act(np.ones(2)))
