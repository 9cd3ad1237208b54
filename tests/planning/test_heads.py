"""Which head plans: the best on the last N transitions; and the networks folded for a plan."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import toys
from headway.config import CEMConfig, PlannerConfig
from headway.errors import ConfigError
from headway.models.acting import (
    MultiHeadModel,
    bounded_var,
    fold,
    head_errors,
    rough_swish,
    select_heads,
)
from headway.models.base import RecentTransitions, Transition
from headway.models.multi_headed import MultiHeadDynamics, network_input
from headway.models.networks import (
    DenseHeads,
    GaussianNet,
    Normalizer,
    bound_logvar,
    rounded,
    swish,
)
from headway.planning.controller import Controller
from headway.planning.flop import plan_flop

UP, DOWN = 1.0, -1.0
NET = toys.linear_model([[np.eye(2), -np.eye(2)], [-np.eye(2), np.eye(2)]])
UP_HEADS, DOWN_HEADS = [0, 1], [1, 0]  # the heads of the two members that know each physics
SLOTS = 6
YES = jnp.asarray([True])


def model_of(net=NET, *, statistics=None, task=toys.POINT, planner=None):
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


def choose(pushes, *, net=NET, statistics=None, key=0, **settings):
    model = model_of(net, statistics=statistics, planner=PlannerConfig(**settings))
    keys = jnp.stack([jax.random.key(key), jax.random.key(7)])
    return chosen(model, remember(pushes), keys)[0].tolist()


def spread_over_keys(pushes, **settings):
    return {tuple(choose(pushes, key=key, **settings)) for key in range(30)}


@pytest.mark.parametrize(
    ("pushes", "length", "expected"),
    [
        ([UP] * 5 + [DOWN], 1, DOWN_HEADS),
        ([DOWN] * 5 + [UP], 1, UP_HEADS),
        ([-9.0, UP, UP, UP], 3, UP_HEADS),
        ([-9.0, UP, UP, UP], 4, DOWN_HEADS),
        ([UP, UP, UP, -9.0], 3, DOWN_HEADS),
        ([UP], 5, UP_HEADS),
        ([DOWN, DOWN], 5, DOWN_HEADS),
        ([-9.0] + [UP] * 6, 6, UP_HEADS),
    ],
)
def test_each_member_takes_the_head_that_is_best_on_the_last_n_and_no_older(
    pushes, length, expected
):
    assert choose(pushes, selection_length=length) == expected


@pytest.mark.parametrize(
    ("pushes", "length", "expected"),
    [
        ([UP, UP, -9.0], 3, UP_HEADS),
        ([-9.0, UP, UP, -9.0], 3, UP_HEADS),
        ([-9.0, UP, UP, -9.0], 4, DOWN_HEADS),
        ([UP, -9.0], 6, UP_HEADS),
    ],
)
def test_skipping_the_newest_leaves_the_n_minus_one_before_it(pushes, length, expected):
    found = choose(pushes, selection_length=length, selection_skips_newest=True)
    assert found == expected


def test_head_is_random_per_member_when_nothing_that_counts_is_remembered():
    length = {"selection_length": SLOTS}
    assert spread_over_keys([], **length) == {(0, 0), (0, 1), (1, 0), (1, 1)}
    assert len(spread_over_keys([UP], selection_skips_newest=True, **length)) == 4
    both = spread_over_keys([UP, UP], selection_skips_newest=True, **length)
    assert both == spread_over_keys([UP], **length) == {tuple(UP_HEADS)}


def noisy_heads(gains, stds):
    """One member whose heads have known gains and noise."""
    net, heads = toys.linear_model([gains]).forward_net, len(stds)
    bias = jnp.broadcast_to(2 * jnp.log(jnp.asarray(stds))[None, :, None], (1, heads, 2))
    logvar = DenseHeads(jnp.zeros(net.mean_heads.weight.shape), bias)
    bounds = jnp.full((heads, 2), 20.0), jnp.full((heads, 2), -60.0)
    return MultiHeadDynamics(GaussianNet(net.hidden, net.mean_heads, logvar, *bounds), None, None)


def test_sampled_error_is_squared_bias_plus_variance_and_the_mean_error_is_bias_alone():
    net = noisy_heads([1.2 * np.eye(2), np.eye(2)], [1e-6, 0.5])
    recent = remember([UP] * SLOTS)
    plain = head_errors(model_of(net), recent[:3], None)
    sampled = head_errors(model_of(net), recent[:3], None, sampling_key=jax.random.key(0))
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
    first_wrong, second_wrong = np.diag([3.0, 0.01]), np.diag([1.0, 0.015])
    scale = Normalizer(jnp.zeros(2), jnp.asarray([1.0, 100.0]))
    statistics = dataclasses.replace(toys.identity_statistics(), delta=scale)
    settings = {"statistics": statistics, "selection_length": SLOTS}
    # Raw errors of (2, 0) and (0, 0.5) times the action; the second dimension weighs little.
    net = noisy_heads([first_wrong, second_wrong], [1e-6, 1e-6])
    assert choose([UP], net=net, **settings) == [1]
    swapped = noisy_heads([np.diag([1.9, 0.01]), np.diag([1.0, 0.03])], [1e-6, 1e-6])
    assert choose([UP], net=swapped, **settings) == [1]
    assert choose([UP], net=swapped, selection_error="sampled", **settings) == [0]


def test_a_non_finite_error_never_wins_and_unused_slots_do_not_count():
    errors = jnp.asarray([[[[jnp.nan, 1.0], [0.0, 9.0], [0.0, jnp.inf]]]])
    key = jax.random.key(0)
    newest_only, both = jnp.asarray([[False, True]]), jnp.asarray([[True, True]])
    assert select_heads(errors, newest_only, key=key).tolist() == [[0]]
    assert select_heads(errors, both, key=key).tolist() == [[1]]


def test_a_transition_is_remembered_only_where_it_happened():
    recent = jax.tree.map(lambda x: jnp.concatenate([x, x]), remember([UP, UP]))
    ones = jnp.ones((2, 2))
    pushed = recent.push(Transition(5 * ones, ones, 6 * ones, jnp.asarray([True, False])))
    np.testing.assert_array_equal(pushed.count, [3, 2])
    np.testing.assert_array_equal(pushed.obs[0, -1], [5.0, 5.0])
    np.testing.assert_array_equal(pushed.next_obs[0, -1], [6.0, 6.0])
    np.testing.assert_array_equal(pushed.obs[0, :-1], recent.obs[0, 1:])
    for after, before in zip(pushed[:3], recent[:3], strict=True):
        np.testing.assert_array_equal(after[1], before[1])


@pytest.mark.parametrize("length", [1, 2, 5, 8])
@pytest.mark.parametrize("num_slots", [8, 11])
def test_history_equals_that_of_the_same_episode_in_the_data_at_every_step(length, num_slots):
    trajectory = toys.random_trajectory(14)
    episodes, _ = toys.lay_out([trajectory])
    recent = RecentTransitions.empty(1, num_slots, toys.POINT)
    obs, action = jnp.asarray(trajectory.obs)[:, None], jnp.asarray(trajectory.action)[:, None]
    for step in range(14):
        expected = episodes.history(jnp.asarray([0]), jnp.asarray([step]), length)
        for got, want in zip(recent.history(length), expected, strict=True):
            np.testing.assert_array_equal(got, want)
        recent = recent.push(Transition(obs[step], action[step], obs[step + 1], YES))


# Networks folded for a plan, with a context that joins them at any place.

TASK = toys.ScaledTask()
NAMES = ("gain", "drag")
CONFIG = dataclasses.replace(toys.SMALL, hidden_sizes=(8, 7, 6))
PLACES = ["input", "last-hidden", "head"]
SMALL_PLAN = PlannerConfig(
    horizon=3,
    num_candidates=12,
    optimizer=CEMConfig(num_elites=4),
    num_iterations=2,
    num_particles=2,
)


def net_at(place, **settings):
    config = dataclasses.replace(CONFIG, context_at=place, **settings)
    return toys.small_model(task=TASK, config=config)


@pytest.mark.parametrize("choices", [1, 2])
@pytest.mark.parametrize("place", [*PLACES, "nowhere"])
def test_folded_networks_predict_what_the_whole_ones_predict(place, choices):
    net = net_at("head", context_size=0) if place == "nowhere" else net_at(place)
    statistics = toys.odd_statistics(TASK)
    rng = np.random.default_rng(0)
    obs, action, noise = jnp.asarray(rng.normal(size=(3, 2, 3, 4, 2)), jnp.float32)
    context = jnp.asarray(rng.normal(size=(2, 3, 3)), jnp.float32)
    context = None if place == "nowhere" else context
    heads = rng.integers(0, 2, (3, 2, 1)) if choices == 1 else np.tile([0, 1], (3, 2, 1))
    model = model_of(net, statistics=statistics, task=TASK)
    dynamics = fold(model, jnp.asarray(heads), context)
    for env in range(3):
        one = dynamics.of_env(jax.tree.map(lambda x, env=env: x[env], dynamics.own))
        wide = [x[:, env].mT[..., None] for x in (obs, action, noise)]  # one candidate
        inputs = network_input(TASK, statistics, obs[:, env], action[:, env])
        told = None if context is None else jnp.repeat(context[:, env, None], 4, axis=1)
        whole = net.forward_net(inputs, told)
        for got, with_noise in (
            (one.step((), wide[0], wide[1], None)[1], 0.0),
            (one.step((), *wide)[1], 1.0),
        ):
            for member in range(2):
                picked = heads[env, member]
                mean = statistics.delta.denormalize(whole.mean[member, picked]).mean(0)
                std = np.exp(0.5 * np.asarray(whole.logvar)[member, picked])
                std = np.sqrt((std**2).sum(0)) / choices * statistics.delta.std
                delta = mean + with_noise * noise[member, env] * std
                wanted = TASK.postprocess(obs[member, env], delta)
                found = got[member, ..., 0].T
                np.testing.assert_allclose(found, wanted, rtol=1e-3, atol=3e-4)


@pytest.mark.parametrize("place", PLACES)
def test_heads_compete_with_the_context_of_their_environment_and_member(place):
    net, statistics = net_at(place), toys.odd_statistics(TASK)
    rng = np.random.default_rng(2)
    obs, action, next_obs = jnp.asarray(rng.normal(size=(3, 3, 4, 2)), jnp.float32)
    context = jnp.asarray(np.random.default_rng(3).normal(size=(2, 3, 3)), jnp.float32)
    model = model_of(net, statistics=statistics, task=TASK)
    errors = head_errors(model, (obs, action, next_obs), context)
    for env in range(3):
        x = network_input(TASK, statistics, obs[env], action[env])
        wide = jnp.repeat(context[:, env, None], 4, axis=1)
        mean = net.forward_net(jnp.broadcast_to(x, (2, *x.shape)), wide).mean
        delta = TASK.target(obs[env], next_obs[env])
        expected = jnp.square(mean - statistics.delta.normalize(delta)).mean(-1)
        np.testing.assert_allclose(errors[env], expected, rtol=1e-4, atol=1e-5)


def told_agent():
    net = net_at("input", context="sim-params", num_heads=1)
    statistics = toys.odd_statistics(TASK, sim_param_names=NAMES)
    return toys.make_agent(net, SMALL_PLAN, statistics=statistics, task=TASK)


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
    with pytest.raises(ConfigError, match="lack drag, allowed: a value for each of gain, drag"):
        controller.reset(sim_params={"gain": 1.0})
    controller.reset(sim_params={"gain": 1.0, "drag": 0.0, "unused": 3.0})
    told = controller.act(np.zeros(2))
    controller.reset()
    with pytest.raises(ConfigError, match="told no sim_params"):
        controller.act(np.zeros(2))
    assert np.isfinite(told).all()


def test_other_controllers_take_no_notice_of_the_physics():
    agent = toys.make_agent(net_at("head"), SMALL_PLAN, task=TASK)
    first, second = Controller(agent), Controller(agent)
    first.reset(sim_params={"gain": 1.0})
    second.reset()
    np.testing.assert_array_equal(first.act(np.ones(2)), second.act(np.ones(2)))


def test_a_context_costs_no_arithmetic_in_a_plan():
    costs = {
        plan_flop(dataclasses.replace(CONFIG, context=kind, context_at=place), SMALL_PLAN, TASK)
        for kind in ("learned", "history", "sim-params")
        for place in PLACES
    }
    sizes = (3 + 2) * 8 + 8 * 7 + 7 * 6 + 6 * 4
    assert costs == {2.0 * sizes * 12 * 2 * 2 * 3}


def test_the_rough_activation_is_within_a_tenth_of_what_bfloat16_loses():
    x = jnp.linspace(-40.0, 40.0, 100_001)
    error = jnp.abs(rough_swish(x) - swish(x))
    assert 1e-5 < error.max() < 2e-4
    above = x > 1
    lost = jnp.abs(swish(x).astype(jnp.bfloat16).astype(jnp.float32) - swish(x))
    assert error[above].mean() < 0.1 * lost[above].mean()
    np.testing.assert_allclose(
        rough_swish(jnp.asarray([1e30, jnp.inf])), [1e30, jnp.inf], rtol=1e-4
    )


def test_the_variance_of_a_plan_is_that_of_bounded_log_variances():
    logvar = jnp.asarray([-300.0, -80.0, -12.0, -3.0, 0.4, 5.0, 80.0, 300.0])
    for bounds in ((-10.0, 0.5), (-40.0, 20.0), (-2.0, -1.5)):
        expected = jnp.exp(bound_logvar(logvar, *map(jnp.float32, bounds)))
        found = bounded_var(logvar, *map(jnp.float32, bounds))
        np.testing.assert_allclose(found, expected, rtol=2e-5)


def test_numbers_are_rounded_to_the_nearest_bfloat16_and_halves_away_from_zero():
    rng = np.random.default_rng(0)
    some = rng.normal(size=10_000) * 10.0 ** rng.uniform(-38, 38, 10_000)
    special = np.asarray([0.0, -0.0, np.inf, -np.inf, np.nan, 3.4e38, 1e-40], np.float32)
    x = np.concatenate([some.astype(np.float32), special])
    x = jnp.asarray(x[x.view(np.uint32) % 2**16 != 2**15])  # not between two of them
    found = rounded(x, jnp.bfloat16)
    assert found.dtype == jnp.bfloat16
    expected = x.astype(jnp.bfloat16).astype(jnp.float32)
    np.testing.assert_array_equal(found.astype(jnp.float32), expected)
    np.testing.assert_array_equal(rounded(x, jnp.float32), x)
    half = jnp.asarray([1 + 2**-8, -1 - 2**-8, 1 + 3 * 2**-8], jnp.float32)
    assert rounded(half, jnp.bfloat16).tolist() == [1 + 2**-7, -1 - 2**-7, 1 + 2**-6]
