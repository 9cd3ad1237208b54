"""The agent as a whole: what it remembers, which head it plans with, what it does."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import toys
from headway.config import CEMConfig, ICEMConfig, MPPIConfig, PlannerConfig, RandomShootingConfig
from headway.models.dynamics import Statistics
from headway.planning import agent as agent_module
from headway.planning.agent import Agent, planning_heads, reset_where

TINY = PlannerConfig(
    horizon=4,
    num_candidates=60,
    optimizer=CEMConfig(num_elites=10),
    num_iterations=4,
    num_particles=2,
    selection_length=2,
)
UP_DOWN = toys.linear_model([[np.eye(2), -np.eye(2)], [-np.eye(2), np.eye(2)]])


def make_agent(model=UP_DOWN, *, statistics=None, history_length=3, **settings):
    statistics = statistics or toys.identity_statistics()
    config = dataclasses.replace(TINY, **settings)
    return Agent(model, statistics, toys.POINT, config, history_length)


def start(agent, num_envs=2, seed=0):
    return agent.init(num_envs, key=jax.random.key(seed))


def play(agent, gains, steps, *, state=None, obs=None):
    """Let the agent act on `obs' = obs + gain * action`; every observation and decision."""
    gains = np.asarray(gains, np.float32)[:, None]
    state = start(agent, len(gains)) if state is None else state
    seen = [np.tile(np.float32([0.8, -0.6]), (len(gains), 1)) if obs is None else obs]
    decisions = []
    for _ in range(steps):
        state, decision = agent.act(state, seen[-1])
        decisions.append(decision)
        seen.append(seen[-1] + gains * np.asarray(decision.action))
    return state, np.stack(seen), decisions


def test_actions_are_bounded_finite_and_of_the_tasks_shape():
    _, _, decisions = play(make_agent(), [1.0, -1.0], 3)
    for decision in decisions:
        assert decision.action.shape == (2, 2)
        assert decision.heads.shape == (2, 2)
        assert np.abs(np.asarray(decision.action)).max() <= 1.0
        np.testing.assert_array_equal(decision.failures, 0)
        np.testing.assert_array_equal(
            decision.evaluations, TINY.num_candidates * TINY.num_iterations
        )


def test_heads_and_actions_follow_each_environments_own_physics_after_one_step():
    agent = make_agent()
    _, seen, decisions = play(agent, [1.0, -1.0], 6)
    for decision in decisions[1:]:
        assert decision.heads.tolist() == [[0, 1], [1, 0]]
    assert (np.square(seen[-1]).sum(-1) < 0.15 * np.square(seen[1]).sum(-1).max() + 0.05).all()


def test_a_change_of_physics_is_noticed_within_n_steps():
    agent = make_agent()
    state, seen, _ = play(agent, [1.0, 1.0], 3)
    decisions = play(agent, [-1.0, -1.0], 4, state=state, obs=seen[-1] + np.float32(0.7))[2]
    assert decisions[3].heads.tolist() == [[1, 0], [1, 0]]


@pytest.mark.parametrize("selection_length", [2, 5])
def test_history_of_a_real_episode_equals_that_of_its_trajectory(selection_length):
    agent = make_agent(selection_length=selection_length)
    state, rng = start(agent), np.random.default_rng(0)
    obs, actions, histories = [rng.normal(size=(2, 2)).astype(np.float32)], [], []
    for _ in range(8):
        state, decision = agent.act(state, obs[-1])
        histories.append(state.recent.history(agent.history_length))
        actions.append(np.asarray(decision.action))
        obs.append(rng.normal(size=(2, 2)).astype(np.float32))
    trajectories = [
        toys.Trajectory(*map(np.stack, (o, a)), np.zeros(8, np.float32), {})
        for o, a in zip(np.stack(obs, 1), np.stack(actions, 1), strict=True)
    ]
    episodes, _ = toys.lay_out(trajectories)
    for step, got in enumerate(histories):
        want = episodes.history(jnp.arange(2), jnp.full(2, step), agent.history_length)
        np.testing.assert_array_equal(got.obs_diff, want.obs_diff)
        np.testing.assert_array_equal(got.action, want.action)


@pytest.mark.parametrize(
    "settings",
    [
        {"optimizer": ICEMConfig(initial_std=0.4321), "num_iterations": 2},
        {"optimizer": MPPIConfig(initial_std=0.4321)},
    ],
    ids=str,
)
def test_act_is_traced_once_whatever_the_optimizer_remembers(settings, monkeypatch):
    traces = []
    original = agent_module.encode
    monkeypatch.setattr(agent_module, "encode", lambda *x: traces.append(1) or original(*x))
    agent = make_agent(**settings)
    state, _, _ = play(agent, [1.0, -1.0], 2)
    play(agent, [1.0, -1.0], 2, state=reset_where(state, start(agent), jnp.asarray([True, False])))
    assert len(traces) == 1


def test_act_is_traced_once_over_episodes_steps_and_new_weights(monkeypatch):
    traces = []
    original = agent_module.encode
    monkeypatch.setattr(agent_module, "encode", lambda *x: traces.append(1) or original(*x))
    agent = make_agent(toys.small_model(), initial_std=0.4321)  # settings no other test compiled
    fresh = start(agent)
    state, _, _ = play(agent, [1.0, -1.0], 4)
    state = reset_where(state, fresh, jnp.asarray([True, True]))
    better = dataclasses.replace(agent, model=toys.small_model(1), statistics=toys.odd_statistics())
    play(better, [1.0, -1.0], 4, state=state)
    assert len(traces) == 1


def test_same_state_same_action_and_the_key_moves_on():
    agent = make_agent()
    obs = jnp.asarray([[0.5, 0.5], [0.1, -0.4]])
    state = start(agent)
    after, first = agent.act(state, obs)
    _, again = agent.act(state, obs)
    _, other = agent.act(start(agent, seed=1), obs)
    np.testing.assert_array_equal(first.action, again.action)
    assert (first.action != other.action).any()
    assert (jax.random.key_data(after.key) != jax.random.key_data(state.key)).any()


def test_what_one_environment_sees_does_not_change_anothers_plan():
    agent = make_agent(toys.small_model())
    _, first = agent.act(start(agent), jnp.asarray([[0.5, 0.5], [0.1, -0.4]]))
    _, second = agent.act(start(agent), jnp.asarray([[-0.9, 2.5], [0.1, -0.4]]))
    np.testing.assert_array_equal(first.action[1], second.action[1])
    assert (first.action[0] != second.action[0]).any()


def test_an_environment_without_finite_returns_keeps_its_guess_and_is_counted_alone():
    agent = make_agent()
    state, seen, _ = play(agent, [1.0, 1.0], 2)
    _, healthy = agent.act(state, seen[-1])
    after, decision = agent.act(state, np.stack([[np.nan, np.nan], seen[-1][1]]))
    np.testing.assert_array_equal(decision.failures, [TINY.num_iterations, 0])
    np.testing.assert_array_equal(decision.action[0], state.search.guess[0, 0])
    np.testing.assert_array_equal(after.search.guess[0, :-1], state.search.guess[0, 1:])
    np.testing.assert_array_equal(decision.action[1], healthy.action[1])


def test_next_guess_is_the_plan_shifted_by_one_and_ends_in_zero():
    agent = make_agent(optimizer=RandomShootingConfig())
    state, decision = agent.act(start(agent), jnp.asarray([[0.5, 0.5], [0.1, -0.4]]))
    np.testing.assert_array_equal(state.search.guess[:, -1], 0.0)
    assert np.asarray(state.search.guess[:, :-1]).all()
    assert (state.search.guess[:, 0] != decision.action).any()


def test_random_selection_ignores_the_data_and_draws_anew_at_every_step():
    agent = make_agent(head_selection="random")
    _, _, decisions = play(agent, [1.0, 1.0], 25)
    assert len({str(decision.heads[0].tolist()) for decision in decisions}) == 4


def test_averaging_plans_with_all_heads_and_reports_the_adaptive_one():
    agent = make_agent(head_selection="average")
    _, _, decisions = play(agent, [1.0, -1.0], 2)
    assert decisions[1].heads.tolist() == [[0, 1], [1, 0]]
    np.testing.assert_array_equal(
        planning_heads(agent, decisions[1].heads), np.tile([0, 1], (2, 2, 1))
    )
    chosen = planning_heads(make_agent(), decisions[1].heads)
    np.testing.assert_array_equal(chosen[..., 0], decisions[1].heads)


def test_the_released_codes_choices_of_planning_act_too():
    agent = make_agent(
        toys.small_model(),
        selection_error="sampled",
        selection_skips_newest=True,
        reward="released",
    )
    _, _, decisions = play(agent, [1.0, -1.0], 3)
    assert np.isfinite(decisions[-1].action).all()
    np.testing.assert_array_equal(decisions[-1].failures, 0)


def test_a_constant_observation_dimension_plans_without_failures():
    trajectories = [toys.random_trajectory(6, seed=n, constant=True) for n in range(2)]
    statistics = Statistics.fit(toys.POINT, trajectories, 3)
    agent = make_agent(toys.small_model(), statistics=statistics)
    state = start(agent)
    for _ in range(3):
        state, decision = agent.act(state, jnp.asarray([[0.5, 0.2], [0.1, 0.2]]))
        assert np.isfinite(decision.action).all()
        np.testing.assert_array_equal(decision.failures, 0)


def test_reset_forgets_the_named_environments_only():
    agent = make_agent()
    fresh = start(agent, seed=5)
    state, seen, _ = play(agent, [1.0, -1.0], 3)
    reset = reset_where(state, fresh, jnp.asarray([False, True]))
    parts, before, empty = (
        jax.tree.leaves(part._replace(key=None)) for part in (reset, state, fresh)
    )
    for got, old, new in zip(parts, before, empty, strict=True):
        np.testing.assert_array_equal(got[0], old[0])
        np.testing.assert_array_equal(got[1], new[1])
    assert reset.key == state.key
    after, _ = agent.act(reset, seen[-1])
    np.testing.assert_array_equal(after.recent.count, [3, 0])
