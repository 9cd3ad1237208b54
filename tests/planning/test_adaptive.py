"""Agents whose model changes while they act: what they remember, forget and imagine."""

import functools

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import toys
from headway.config import CEMConfig, GradientAdaptedConfig, PlannerConfig, RecurrentConfig
from headway.models.base import RecentTransitions, Transition
from headway.models.grbal import GrBAL, ReluNet, Window, adapt
from headway.models.multi_headed import network_input
from headway.models.rebal import ReBAL, RecurrentNet
from headway.planning.agent import Agent
from headway.planning.controller import Controller
from headway.planning.rollouts import candidate_returns
from headway.task import env_action
from headway.training.diagnostics import imagine

TASK = toys.ScaledTask()
SIZES = (6, 5)
PLANNER = PlannerConfig(
    horizon=3,
    num_candidates=8,
    optimizer=CEMConfig(num_elites=2),
    num_iterations=2,
    num_particles=1,
)
KINDS = ["gradient", "recurrent"]

KEYS = jax.random.split(jax.random.key(0))

close = functools.partial(np.testing.assert_allclose, rtol=1e-5, atol=1e-6)


def model_of(kind, length=3, rate=0.1):
    statistics = toys.odd_statistics(TASK)
    if kind == "gradient":
        config = GradientAdaptedConfig(hidden_sizes=SIZES)
        net = ReluNet.init(config, TASK, key=jax.random.key(0))
        return GrBAL(net, statistics, TASK, length, rate)
    net = RecurrentNet.init(RecurrentConfig(hidden_sizes=SIZES), TASK, key=jax.random.key(0))
    return ReBAL(net, statistics, TASK)


def transitions(count, num_envs=2, seed=0):
    rng = np.random.default_rng(seed)
    obs = rng.normal(size=(count + 1, num_envs, 2)).astype(np.float32)
    action = rng.uniform(-1, 1, (count, num_envs, 2)).astype(np.float32)
    yes = jnp.ones(num_envs, bool)
    return [
        Transition(jnp.asarray(obs[t]), jnp.asarray(action[t]), jnp.asarray(obs[t + 1]), yes)
        for t in range(count)
    ]


@eqx.filter_jit
def live(model, steps):
    memory = model.init_belief(len(steps[0].obs))
    for step in steps:
        memory = model.observe(memory, step, KEYS)
    return memory


@eqx.filter_jit
def delta_of(model, memory, obs, action):
    """What `dynamics` predicts of one step, per environment."""
    dynamics = model.dynamics(memory, "float32")

    def one(part, obs, action):
        one = dynamics.of_env(part)
        carry = jax.tree.map(lambda x: x[..., None, None], one.start())
        wide = obs[None, :, None, None], action[None, :, None, None]
        return one.step(carry, *wide, None)[1][0, :, 0, 0]

    return jax.vmap(one)(dynamics.own, obs, action)


def predicted(net, statistics, obs, action):
    x = network_input(TASK, statistics, obs, action)
    return TASK.postprocess(obs, statistics.delta.denormalize(net(x)))


def test_weights_are_adapted_to_the_last_transitions_of_each_environment():
    model, steps = model_of("gradient"), transitions(5)
    memory, now = live(model, steps), steps[0]
    found = delta_of(model, memory, now.obs, now.action)
    for env in range(2):
        newest = [[getattr(s, name)[env] for s in steps[-3:]] for name in Transition._fields[:3]]
        past = Window.of(TASK, model.statistics, tuple(jnp.stack(x) for x in newest), jnp.ones(3))
        net = adapt(model.net, past, 0.1)
        wanted = predicted(net, model.statistics, now.obs[env][None], now.action[env][None])[0]
        np.testing.assert_allclose(found[env], wanted, rtol=1e-4, atol=1e-5)
    plain = predicted(model.net, model.statistics, now.obs, now.action)
    assert np.abs(found - plain).min() > 1e-5


def test_weights_are_the_meta_learned_ones_until_there_is_enough_to_adapt_to():
    model, steps = model_of("gradient"), transitions(3)
    now = steps[0]
    plain = predicted(model.net, model.statistics, now.obs, now.action)
    few, enough = (delta_of(model, live(model, s), now.obs, now.action) for s in (steps[:2], steps))
    np.testing.assert_allclose(few, plain, rtol=1e-4, atol=1e-5)
    assert np.abs(enough - plain).max() > 1e-4


def test_the_state_goes_on_by_what_was_observed_and_done():
    model, steps = model_of("recurrent"), transitions(4)
    memory, state = live(model, steps), model.net.start(2)
    for step in steps:
        x = network_input(TASK, model.statistics, step.obs, step.action)
        state, _ = model.net(state, x)
    jax.tree.map(close, memory, state)
    now = steps[0]
    x = network_input(TASK, model.statistics, now.obs, now.action)
    delta = model.statistics.delta.denormalize(model.net(state, x)[1])
    found = delta_of(model, memory, now.obs, now.action)
    np.testing.assert_allclose(found, now.obs + delta, rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize("kind", KINDS)
def test_what_did_not_happen_is_not_remembered(kind):
    model, steps = model_of(kind), transitions(4)
    before = live(model, steps[:3])
    after = model.observe(before, steps[3]._replace(happened=jnp.array([True, False])), KEYS)
    for old, new in zip(jax.tree.leaves(before), jax.tree.leaves(after), strict=True):
        np.testing.assert_array_equal(old[1], new[1])
    changed = jax.tree.map(lambda old, new: bool((old[0] != new[0]).any()), before, after)
    assert any(jax.tree.leaves(changed))


@pytest.mark.parametrize("kind", KINDS)
def test_returns_are_those_of_steps_taken_one_by_one(kind):
    model, memory = model_of(kind), live(model_of(kind), transitions(5))
    rng = np.random.default_rng(2)
    obs = jnp.asarray(rng.normal(size=(2, 2)), jnp.float32)
    candidates = jnp.asarray(rng.uniform(-1, 1, (2, 4, 3, 2)), jnp.float32)
    dynamics = model.dynamics(memory, "float32")
    key = jax.random.key(0)
    found = candidate_returns(dynamics, TASK, obs, candidates, planner=PLANNER, key=key)
    for env, candidate in ((0, 0), (0, 3), (1, 1)):
        state, now, total, alive = memory, obs, 0.0, True
        for step in range(3):
            action = jnp.broadcast_to(candidates[env, candidate, step], (2, 2))
            after = delta_of(model, state, now, action)
            paid = TASK.reward(now, TASK.scale_action(action), after)[env]
            total += float(paid) if alive else 0.0
            alive = alive and not bool(TASK.terminated(now, action, after)[env])
            if kind == "recurrent":  # imagined steps go into the state, but change no weights
                yes = jnp.ones(2, bool)
                state = model.observe(state, Transition(now, action, after, yes), KEYS)
            now = after
        np.testing.assert_allclose(found[env, candidate], total, rtol=1e-4, atol=1e-4)


@pytest.mark.parametrize("kind", KINDS)
def test_an_agent_learns_from_its_steps_and_begins_every_episode_anew(kind):
    agent = Agent(model_of(kind), TASK, PLANNER)
    rng = np.random.default_rng(0)
    observed = rng.normal(size=(6, 2, 2)).astype(np.float32)

    def play():
        state, actions = agent.init(2, key=jax.random.key(0)), []
        for obs in observed:
            state, decision = agent.act(state, obs)
            actions.append(np.asarray(decision.action))
        return state, np.stack(actions)

    state, actions = play()
    steps = [
        Transition(*map(jnp.asarray, (observed[t], actions[t], observed[t + 1])), jnp.ones(2, bool))
        for t in range(5)
    ]
    jax.tree.map(close, state.belief, live(agent.model, steps))
    np.testing.assert_array_equal(play()[1], actions)  # nothing is left of the first episode
    fresh = agent.init(2, key=jax.random.key(0)).belief
    jax.tree.map(np.testing.assert_array_equal, fresh, agent.model.init_belief(2))


@pytest.mark.parametrize("kind", KINDS)
def test_imagining_lives_through_the_past_first(kind):
    agent = Agent(model_of(kind), TASK, PLANNER)
    steps = transitions(5)
    slots = [jnp.stack([getattr(s, name) for s in steps], 1) for name in Transition._fields[:3]]
    actions = jnp.asarray(np.random.default_rng(4).uniform(-1, 1, (2, 2, 2)), jnp.float32)
    young = RecentTransitions(*slots, jnp.array([5, 3]))
    found = imagine(agent.model, young, actions, KEYS)[0, :, 0]
    for env, count in ((0, 5), (1, 3)):
        memory = live(agent.model, steps[5 - count :])
        wanted = delta_of(agent.model, memory, steps[-1].next_obs, actions[:, 0])[env]
        np.testing.assert_allclose(found[env], wanted, rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize("kind", KINDS)
def test_bfloat16_products_stay_close(kind):
    model, steps = model_of(kind), transitions(5)
    memory, now = live(model, steps), steps[0]
    obs, candidates = now.obs, now.action[:, None, None]
    key = jax.random.key(0)
    exact, coarse = (
        candidate_returns(
            model.dynamics(memory, precision), TASK, obs, candidates, planner=PLANNER, key=key
        )
        for precision in ("float32", "bfloat16")
    )
    assert 0 < np.abs(exact - coarse).max() < 0.1


def test_a_controller_holds_to_the_last_plan_where_a_sensor_fails():
    controller = Controller(Agent(model_of("recurrent"), TASK, PLANNER))
    controller.act(np.zeros(2))
    memory, plan = jax.device_get((controller._state.belief, controller._state.search.nominal[0]))
    for step in range(PLANNER.horizon - 1):
        found = controller.act(np.array([np.nan, 0.0]))
        np.testing.assert_allclose(found, env_action(TASK, plan[step]), atol=1e-6)
    assert controller.status is not None
    assert controller.status.outcome == "held"
    assert controller.act(np.zeros(2)).shape == (2,)
    assert controller.status.outcome == "planned"
    # What was done unseen is no transition to learn from.
    jax.tree.map(np.testing.assert_array_equal, controller._state.belief, memory)


@pytest.mark.parametrize("kind", ["gradient", "recurrent"])
def test_a_deadline_that_is_long_enough_changes_nothing(kind):
    agent = Agent(model_of(kind), TASK, PLANNER)
    plain, timed = Controller(agent), Controller(agent, deadline_ms=1e6)
    for step in range(3):
        obs = np.array([0.1 * step, -0.2])
        np.testing.assert_allclose(timed.act(obs), plain.act(obs), atol=1e-5)
    assert timed.status is not None
    assert timed.status.outcome == "planned"


@pytest.mark.parametrize("kind", ["gradient", "recurrent"])
def test_observations_unlike_the_training_data_are_named(kind):
    controller = Controller(Agent(model_of(kind), TASK, PLANNER))
    controller.act(np.full(2, 1e4))
    assert controller.status is not None
    assert controller.status.outcome == "planned"
    assert controller.status.warnings


def test_an_iteration_that_failed_is_no_failed_plan(monkeypatch):
    act = Agent.act

    def fails_once(self, state, obs):
        state, decision = act(self, state, obs)
        return state, decision._replace(failures=jnp.ones(1, jnp.int32))

    monkeypatch.setattr(Agent, "act", fails_once)
    controller = Controller(Agent(model_of("recurrent"), TASK, PLANNER))
    controller.act(np.zeros(2))
    assert controller.status is not None
    assert (controller.status.outcome, controller.status.iterations) == ("planned", 2)
