"""The iterative linear-quadratic regulator: the exact solution, unstable machines, its refusals."""

import dataclasses
from typing import ClassVar

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import headway
import headway.envs
import toys
from headway.config import Config, ILQRConfig, PlannerConfig, override
from headway.errors import ConfigError
from headway.models.simulator import ClassicSimulator
from headway.planning.agent import Agent
from headway.planning.controller import Controller
from headway.planning.rollouts import follow
from headway.spaces import Spaces

HORIZON, COST = 12, 0.3
A, B = np.array([[1.1, 0.4], [0.3, 1.2]]), np.array([[0.2, 0.0], [0.1, 0.3]])
START = np.float32([[0.05, -0.02], [-0.01, 0.03]])


def agent_of(predict, task, num_candidates=6, num_iterations=1, optimizer=None, horizon=HORIZON):
    optimizer = optimizer or ILQRConfig(action_cost=COST)
    planner = PlannerConfig(optimizer, horizon, num_candidates, num_iterations, 1)
    return Agent(headway.FunctionModel((), predict), task, planner)


def linear(_, obs, action):
    return obs @ A.T + action @ B.T


def plans(agent, obs, key=0):
    return agent.act(agent.init(len(obs), key=jax.random.key(key)), obs)[0].search


def riccati():
    """Gains of the last step first, for next_obs² + 0.1 action² and `COST` action²."""
    value, gains = np.eye(2), []
    for _ in range(HORIZON):
        own = B.T @ value @ B + (0.1 + COST) * np.eye(2)
        gains.append(-np.linalg.solve(own, B.T @ value @ A))
        value = np.eye(2) + A.T @ value @ (A + B @ gains[-1])
    return gains


def test_one_iteration_solves_a_linear_quadratic_problem():
    policy = plans(agent_of(linear, toys.PointTask()), START)  # where the next search starts
    for env, obs in enumerate(np.float64(START)):
        gains = riccati()
        for step in range(HORIZON - 1):
            obs = (A + B @ gains.pop()) @ obs  # noqa: PLW2901
            np.testing.assert_allclose(policy.expected[env, step], obs, atol=1e-5)
            np.testing.assert_allclose(policy.gain[env, step], gains[-1], atol=1e-4)
            np.testing.assert_allclose(policy.nominal[env, step], gains[-1] @ obs, atol=1e-5)


class BalanceTask(headway.Task):
    """Two numbers, each growing by half of itself in a step; only the second one is pushed."""

    obs_size: ClassVar[int] = 2
    action_size: ClassVar[int] = 1
    action_low: ClassVar[tuple[float, ...]] = (-2.0,)
    action_high: ClassVar[tuple[float, ...]] = (2.0,)

    def reward(self, obs, action, next_obs):
        return 1.0 - 0.1 * jnp.square(next_obs).sum(-1)

    def terminated(self, obs, action, next_obs):
        return (jnp.abs(next_obs) > 1.0).any(-1)


def grows(_, obs, action):
    pushed = jnp.stack([obs[..., 1], action[..., 0]], -1)
    return obs + 0.5 * jnp.sin(obs) + 0.3 * pushed


def test_an_unstable_machine_is_held_against_disturbances():
    agent = agent_of(grows, BalanceTask(), 8, 3, ILQRConfig(), horizon=30)
    state, obs, rng = (
        agent.init(8, key=jax.random.key(0)),
        np.zeros((8, 2)),
        np.random.default_rng(0),
    )
    for _ in range(60):
        state, decision = agent.act(state, obs)
        obs = np.asarray(grows(None, obs, decision.action)) + rng.normal(0, 0.02, obs.shape)
        assert (np.abs(obs) < 0.5).all()


class GreedyTask(BalanceTask):
    """Every step pays more farther to the right, and nothing more beyond 1."""

    obs_size: ClassVar[int] = 1

    def reward(self, obs, action, next_obs):
        return 1.0 + 0.1 * next_obs[..., 0]


def test_what_comes_after_the_end_counts_nothing():
    agent = agent_of(lambda _, obs, action: obs + 0.2 * action, GreedyTask(), 11, 4, ILQRConfig())
    policy = plans(agent, np.zeros((1, 1)))
    assert 0.7 < policy.expected.max() <= 1.0


@pytest.mark.parametrize("num_candidates", [1, 8])
def test_a_fall_that_is_imagined_first_does_not_hide_the_way_to_stay_up(num_candidates):
    class EdgeTask(GreedyTask):
        def reward(self, obs, action, next_obs):
            return 1.0 - 0.1 * jnp.square(next_obs[..., 0])

    agent = agent_of(
        lambda _, obs, action: 1.5 * obs + 0.1 * action,
        EdgeTask(),
        num_candidates,
        3,
        ILQRConfig(),
        horizon=30,
    )
    state, obs = agent.init(1, key=jax.random.key(0)), np.float32([[0.05]])
    for _ in range(10):
        state, decision = agent.act(state, obs)
        obs = np.asarray(1.5 * obs + 0.05 * agent.task.scale_action(decision.action))
    assert np.abs(obs).max() < 0.02
    assert np.abs(state.search.expected).max() < 0.1


def test_a_plan_without_time_to_search_answers_the_observation():
    agent = agent_of(linear, toys.PointTask(), num_iterations=3)
    state, _ = agent.act(agent.init(2, key=jax.random.key(0)), START)
    expected, surprise = state.search.expected[:, 0], np.float32([0.02, -0.05])
    _, decision = agent.end(agent.begin(state, expected + surprise))
    gain = np.float64(riccati()[-2])  # of the second step
    np.testing.assert_allclose(decision.action, (expected + surprise) @ gain.T, atol=1e-4)


def test_a_model_that_carries_a_state_is_refused():
    planner = dataclasses.replace(PlannerConfig(ILQRConfig()), num_particles=1)
    vector = headway.envs.make_vec("pendulum", 1)
    task = headway.env_spec("pendulum").make_task()
    agent = Agent(ClassicSimulator(vector, task), task, planner)
    with pytest.raises(ConfigError, match="which carries a state"):
        agent.act(agent.init(1, key=jax.random.key(0)), np.zeros((1, 3)))


def test_an_environment_without_finite_returns_keeps_its_plan_and_counts_failures():
    agent = agent_of(lambda _, obs, action: obs + action / (obs[..., :1] < 9), toys.PointTask())
    obs = np.float32([[9.5, 0.0], [0.05, 0.0]])
    _, decision = agent.act(agent.init(2, key=jax.random.key(0)), obs)
    np.testing.assert_array_equal(decision.failures, [1, 0])
    np.testing.assert_array_equal(decision.action[0], 0.0)
    assert (decision.action[1] != 0).any()
    # The last plan and its steps' slopes, by each number; six candidates, and no change.
    np.testing.assert_array_equal(decision.evaluations, 1 + 1 + 4 + 6 + 1)


def test_a_plan_in_parts_and_one_that_is_bfloat16_agree_with_the_whole():
    optimizer, few = ILQRConfig(), {"horizon": 6, "num_candidates": 5, "num_iterations": 2}
    agents = [
        toys.make_agent(toys.small_model(), optimizer=optimizer, precision=precision, **few)
        for precision in ("float32", "bfloat16")
    ]
    whole, parts, rough = (
        Controller(agent, deadline_ms=deadline)
        for agent, deadline in ((agents[0], None), (agents[0], 1e7), (agents[1], None))
    )
    for obs in np.random.default_rng(0).normal(0, 0.3, (4, 2)):
        action = whole.act(obs)
        np.testing.assert_allclose(parts.act(obs), action, atol=1e-5)
        np.testing.assert_allclose(rough.act(obs), action, atol=0.05)


def test_a_plan_with_feedback_expects_what_the_members_predict_together():
    agent = toys.make_agent(toys.small_model(), optimizer=ILQRConfig(), horizon=6, num_iterations=2)
    controller, obs = Controller(agent), np.float32([0.3, -0.2])
    action = agent.task.unscale_action(jnp.asarray(controller.act(obs))[None, None])
    dynamics = agent.model.dynamics(controller._state.belief, "float32")
    each = follow(dynamics, jnp.asarray(obs)[None], action)
    (expected,) = controller.imagine()
    assert each.shape[0] > 1
    np.testing.assert_allclose(expected[0], each[:, 0, 0].mean(0), atol=1e-5)


@pytest.mark.parametrize(
    "settings",
    [
        {"model.kind": "recurrent", "planner.num_particles": 1},
        {"model.kind": "simulator", "planner.num_particles": 1},
        {"model.learned_reward": True},
        {"planner.reward": "released"},
        {"spaces": Spaces(2, "categories", (0.0,), (3.0,), (), "int64")},
    ],
    ids=str,
)
def test_ilqr_is_refused_where_it_has_no_slopes_to_follow(settings):
    asked = {"planner.optimizer.name": "ilqr"}
    assert override(Config(env="pendulum"), asked).planner.optimizer == ILQRConfig()
    with pytest.raises(ConfigError, match=r"optimizer.name is 'ilqr', allowed: another search, or"):
        override(Config(env="pendulum"), asked | settings)
