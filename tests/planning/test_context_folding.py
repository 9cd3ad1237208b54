"""A context that joins a hidden layer: folded plans, head selection, agents that know physics."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import toys
from headway.config import CEMConfig, PlannerConfig
from headway.errors import ConfigError
from headway.models.dynamics import network_input
from headway.planning.agent import Agent, encode
from headway.planning.controller import Controller
from headway.planning.flop import plan_flop
from headway.planning.heads import RecentTransitions, head_errors
from headway.planning.imagination import ImaginedDynamics
from headway.planning.returns import RolloutSettings, candidate_returns

TASK = toys.ScaledTask()
NAMES = ("gain", "drag")
CONFIG = dataclasses.replace(toys.SMALL, hidden_sizes=(8, 7, 6))
PLACES = ["input", "last-hidden", "head"]
PLANNER = PlannerConfig(
    horizon=3,
    num_candidates=12,
    optimizer=CEMConfig(num_elites=4),
    num_iterations=2,
    num_particles=2,
)


def model_at(place, **settings):
    config = dataclasses.replace(CONFIG, context_at=place, **settings)
    return toys.small_model(task=TASK, config=config)


@pytest.mark.parametrize("choices", [1, 2])
@pytest.mark.parametrize("place", PLACES)
def test_a_folded_context_predicts_what_the_concatenated_one_predicts(place, choices):
    model, statistics = model_at(place), toys.odd_statistics(TASK)
    rng = np.random.default_rng(0)
    obs, action, noise = jnp.asarray(rng.normal(size=(3, 2, 3, 4, 2)), jnp.float32)
    context = jnp.asarray(rng.normal(size=(2, 3, 3)), jnp.float32)
    heads = rng.integers(0, 2, (3, 2, 1)) if choices == 1 else np.tile([0, 1], (3, 2, 1))
    dynamics = ImaginedDynamics.fold(model, statistics, jnp.asarray(heads), context)
    for env in range(3):
        one = dynamics.of_env(jax.tree.map(lambda x, env=env: x[env], dynamics.heads))
        x = jnp.concatenate([TASK.preprocess(obs[:, env]), action[:, env]], axis=-1)
        got = one.sample_delta(x.mT[..., None], noise[:, env].mT[..., None])[..., 0].mT
        inputs = network_input(TASK, statistics, obs[:, env], action[:, env])
        whole = model.forward_net(inputs, jnp.repeat(context[:, env, None], 4, axis=1))
        for member in range(2):
            picked = heads[env, member]
            mean = np.asarray(whole.mean)[member, picked].mean(0)
            mean = mean * statistics.delta.std + statistics.delta.mean
            std = np.exp(0.5 * np.asarray(whole.logvar)[member, picked])
            std = np.sqrt((std**2).sum(0)) / choices * statistics.delta.std
            expected = mean + noise[member, env] * std
            np.testing.assert_allclose(got[member], expected, rtol=1e-3, atol=2e-4)


@pytest.mark.parametrize("place", ["input"])
def test_environments_imagine_with_their_own_context(place):
    rng = np.random.default_rng(1)
    context = jnp.asarray(rng.normal(size=(2, 3, 3)), jnp.float32)
    model, statistics = model_at(place), toys.odd_statistics(TASK)
    heads = jnp.zeros((3, 2, 1), int)
    obs = jnp.ones((3, 2), jnp.float32)
    candidates = jnp.asarray(np.tile(rng.uniform(-1, 1, (1, 4, 5, 2)), (3, 1, 1, 1)), jnp.float32)

    def returns_of(rows):
        dynamics = ImaginedDynamics.fold(model, statistics, heads[rows], context[:, rows])
        settings = RolloutSettings(particles_per_member=1)
        args = dynamics, TASK, obs[rows], candidates[rows]
        return candidate_returns(*args, settings=settings, key=jax.random.key(0))

    together = returns_of(np.arange(3))
    np.testing.assert_allclose(together[0], returns_of(np.arange(1))[0], rtol=1e-5)
    assert not np.allclose(together[0], together[1], rtol=1e-3)


def recent_transitions(num_envs=3, slots=4):
    rng = np.random.default_rng(2)
    draw = lambda: jnp.asarray(rng.normal(size=(num_envs, slots, 2)), jnp.float32)  # noqa: E731
    return RecentTransitions(draw(), draw(), draw(), jnp.full(num_envs, slots, jnp.int32))


@pytest.mark.parametrize("place", PLACES)
def test_heads_compete_with_the_context_of_their_environment(place):
    model, statistics = model_at(place), toys.odd_statistics(TASK)
    recent = recent_transitions()
    context = jnp.asarray(np.random.default_rng(3).normal(size=(2, 3, 3)), jnp.float32)
    errors = head_errors(model, TASK, statistics, recent, context)
    for env in range(3):
        x = network_input(TASK, statistics, recent.obs[env], recent.action[env])
        wide = jnp.repeat(context[:, env, None], 4, axis=1)
        mean = model.forward_net(jnp.broadcast_to(x, (2, *x.shape)), wide).mean
        delta = TASK.target(recent.obs[env], recent.next_obs[env])
        expected = jnp.square(mean - statistics.delta.normalize(delta)).mean(-1)
        np.testing.assert_allclose(errors[env], expected, rtol=1e-4, atol=1e-5)


def told_agent():
    model = model_at("input", context="sim-params", num_heads=1)
    statistics = toys.odd_statistics(TASK, sim_param_names=NAMES)
    return Agent(model, statistics, TASK, PLANNER, 3)


def test_an_agent_that_is_told_the_physics_plans_with_them():
    agent = told_agent()
    physics = [{"gain": 0.5, "drag": 1.0}, {"gain": -2.0, "drag": 1.0}]
    states = [
        agent.init(2, key=jax.random.key(0), sim_params=told) for told in (physics, physics[::-1])
    ]
    contexts = [encode(agent, state.recent, state.sim_params) for state in states]
    std, mean = agent.statistics.sim_params.std, agent.statistics.sim_params.mean
    expected = (np.array([[0.5, 1.0], [-2.0, 1.0]]) - mean) / std
    np.testing.assert_allclose(contexts[0], [expected, expected], rtol=1e-5)
    np.testing.assert_allclose(contexts[1], contexts[0][:, ::-1], rtol=1e-6)
    obs = np.ones((2, 2), np.float32)
    first, second = (agent.act(state, obs)[1].action for state in states)
    assert not np.allclose(first, second, atol=1e-3)
    kept, _ = agent.act(states[0], obs)
    np.testing.assert_array_equal(kept.sim_params, states[0].sim_params)


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
    agent = Agent(model_at("head"), toys.odd_statistics(TASK), TASK, PLANNER, 3)
    first, second = Controller(agent), Controller(agent)
    first.reset(sim_params={"gain": 1.0})
    second.reset()
    np.testing.assert_array_equal(first.act(np.ones(2)), second.act(np.ones(2)))


def test_a_context_costs_no_arithmetic_in_a_plan():
    costs = {
        plan_flop(dataclasses.replace(CONFIG, context=kind, context_at=place), PLANNER, TASK)
        for kind in ("learned", "history", "sim-params")
        for place in PLACES
    }
    sizes = (3 + 2) * 8 + 8 * 7 + 7 * 6 + 6 * 4
    assert costs == {2.0 * sizes * 12 * 2 * 2 * 3}
