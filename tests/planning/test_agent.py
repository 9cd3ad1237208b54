"""The agent as a whole: what it remembers, which head it plans with, what it does."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np

import toys
from headway.config import CEMConfig
from headway.models.base import FunctionModel
from headway.planning.agent import Agent

OBS = jnp.asarray([[0.5, 0.5], [0.1, -0.4]])


def start(agent, num_envs=2, seed=0):
    return agent.init(num_envs, key=jax.random.key(seed))


def play(agent, gains, steps):
    """Let the agent act on `obs' = obs + gain * action`; every observation and decision."""
    gains = np.asarray(gains, np.float32)[:, None]
    state, decisions = start(agent, len(gains)), []
    seen = [np.tile(np.float32([0.8, -0.6]), (len(gains), 1))]
    for _ in range(steps):
        state, decision = agent.act(state, seen[-1])
        decisions.append(decision)
        seen.append(seen[-1] + gains * np.asarray(decision.action))
    return state, np.stack(seen), decisions


def test_heads_and_actions_follow_each_environments_own_physics_after_one_step():
    _, seen, decisions = play(toys.make_agent(), [1.0, -1.0], 6)
    for decision in decisions:
        assert np.abs(decision.action).max() <= 1.0
        np.testing.assert_array_equal(decision.failures, 0)
        np.testing.assert_array_equal(decision.evaluations, 60 * 4)
    for decision in decisions[1:]:
        assert decision.heads.tolist() == [[0, 1], [1, 0]]
    assert (np.square(seen[-1]).sum(-1) < 0.15 * np.square(seen[1]).sum(-1).max() + 0.05).all()


def test_same_state_same_action_and_the_key_moves_on():
    agent = toys.make_agent(toys.small_model())
    state = start(agent)
    after, first = agent.act(state, OBS)
    _, again = agent.act(state, OBS)
    _, other = agent.act(start(agent, seed=1), OBS)
    _, beside = agent.act(state, OBS.at[0].set(jnp.asarray([-0.9, 2.5])))
    np.testing.assert_array_equal(first.action, again.action)
    assert (first.action != other.action).any()
    assert (jax.random.key_data(after.key) != jax.random.key_data(state.key)).any()
    np.testing.assert_array_equal(first.action[1], beside.action[1])  # nor do others matter
    assert (first.action[0] != beside.action[0]).any()


def test_averaging_plans_with_all_heads_and_reports_the_adaptive_one():
    agent = toys.make_agent(head_selection="average")
    state, _, decisions = play(agent, [1.0, -1.0], 2)
    assert decisions[1].heads.tolist() == [[0, 1], [1, 0]]
    obs_size = agent.task.obs_size
    average = agent.model.dynamics(state.belief).own.layer
    chosen = toys.make_agent().model.dynamics(state.belief).own.layer
    np.testing.assert_array_equal(average.weight[..., :obs_size, :], 0.0)  # up and down
    assert np.asarray(chosen.weight[..., :obs_size, :]).any()


def test_any_function_can_be_planned_with():
    model = FunctionModel(jnp.asarray(-0.5), lambda gain, obs, action: obs + gain * action)
    agent = Agent(model, toys.POINT, dataclasses.replace(toys.TINY, num_particles=1))
    _, seen, decisions = play(agent, [-0.5], 6)
    assert decisions[-1].heads is None
    assert np.abs(seen[-1]).max() < 0.2


def test_an_agent_without_a_model_acts_at_random():
    agent = Agent(None, toys.POINT, toys.TINY)
    _, _, decisions = play(agent, [1.0, 1.0], 50)
    actions = np.concatenate([decision.action for decision in decisions])
    assert decisions[0].heads is None
    assert np.abs(actions).max() <= 1.0
    assert len(np.unique(actions)) == actions.size
    np.testing.assert_allclose(actions.std(), 3**-0.5, rtol=0.15)


def test_reduced_precision_chooses_nearly_the_same_actions():
    planner = {"horizon": 5, "num_candidates": 40, "optimizer": CEMConfig(num_elites=8)}
    planner |= {"num_iterations": 3, "num_particles": 4, "selection_length": 10}

    def actions(**settings):
        agent = toys.make_agent(toys.small_model(seed=3), **planner | settings)
        return toys.walk(agent, steps=8)

    exact, reduced, other = actions(), actions(precision="bfloat16"), actions(num_candidates=41)
    difference = np.abs(exact - reduced)
    assert difference.any()
    assert np.median(difference) < 0.02
    assert difference.max() < 0.2
    assert np.median(difference) < 0.3 * np.median(np.abs(exact - other))
