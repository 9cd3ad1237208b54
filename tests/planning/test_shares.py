"""Cores that share the candidates of a plan choose what one program would choose."""

from concurrent.futures import ThreadPoolExecutor

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import toys
from headway.models.meeting import Meeting
from headway.planning import returns, search, shares
from headway.planning.deadline import DeadlinePlanner
from headway.planning.imagination import ImaginedDynamics
from headway.planning.returns import RolloutSettings, candidate_returns
from headway.planning.search import act_in_one
from headway.planning.shares import Question, joined, returns_of_shares, worth_sharing
from planning.test_devices import TINY, actions, make_agent

OBS = np.ones((3, 2), np.float32)
ONE_BY_ONE = 1
"""A budget in which nothing fits."""


@pytest.fixture
def sharing(monkeypatch):
    """Plans of any size are shared by three cores."""
    monkeypatch.setattr(shares, "LEAST", 0)
    monkeypatch.setattr(shares, "num_cpus", lambda: 3)


@pytest.mark.parametrize(
    "settings",
    [
        {},
        {"num_candidates": 41},
        {"precision": "bfloat16"},
        {"particle_noise": "shared", "risk_aversion": 0.5},
        {"optimizer": "icem", "num_elites": 4},
        {"optimizer": "mppi"},
        {"optimizer": "random-shooting"},
        {"settle_tolerance": 0.08, "num_iterations": 8},
    ],
    ids=str,
)
def test_cores_that_share_a_plan_choose_the_actions_of_one_program(settings, sharing, monkeypatch):
    agent = make_agent(**settings)
    shared = actions(agent)
    monkeypatch.setattr(shares, "LEAST", np.inf)
    np.testing.assert_allclose(shared, actions(agent), atol=1e-5)


def test_a_search_that_settles_scores_no_more_candidates_than_one_program(sharing, monkeypatch):
    agent = make_agent(settle_tolerance=0.08, num_iterations=8)
    state = agent.init(3, key=jax.random.key(0))
    _, shared = agent.act(state, OBS)
    monkeypatch.setattr(shares, "LEAST", np.inf)
    _, whole = agent.act(state, OBS)
    np.testing.assert_array_equal(shared.evaluations, whole.evaluations)
    assert 0 < shared.evaluations.min() < shared.evaluations.max() < 8 * TINY.num_candidates


@pytest.mark.parametrize(
    ("cores", "budget", "noise"),
    [
        (2, ONE_BY_ONE, "independent"),
        (2, ONE_BY_ONE, "shared"),
        (4, returns.SHARE_BUDGET, "shared"),
        (7, returns.SHARE_BUDGET, "independent"),
        (40, ONE_BY_ONE, "independent"),
    ],
)
def test_shares_have_the_returns_of_the_whole(budget, cores, noise, monkeypatch):
    monkeypatch.setattr(shares, "num_cpus", lambda: cores)
    monkeypatch.setattr(returns, "SHARE_BUDGET", budget)
    jax.clear_caches()  # what was compiled for the other budget
    question = some_question()
    planner = make_agent(particle_noise=noise).planner
    found = joined(returns_of_shares(question, planner), 7)
    settings = RolloutSettings.of(planner, 2)
    dynamics, task, obs, candidates, key = question
    whole = candidate_returns(dynamics, task, obs, candidates, settings=settings, key=key)
    np.testing.assert_allclose(found, whole, rtol=1e-5)
    assert len(np.unique(whole)) == whole.size


def some_question():
    rng = np.random.default_rng(3)
    heads, context = jnp.asarray(rng.integers(0, 2, (3, 2, 1))), rng.normal(size=(2, 3, 3))
    dynamics = ImaginedDynamics.fold(
        toys.small_model(), toys.identity_statistics(), heads, jnp.asarray(context, jnp.float32)
    )
    candidates = jnp.asarray(rng.uniform(-1, 1, (3, 7, 4, 2)), jnp.float32)
    return Question(dynamics, toys.POINT, jnp.asarray(OBS), candidates, jax.random.key(1))


def test_one_by_one_each_member_imagines_alone(monkeypatch):
    monkeypatch.setattr(returns, "SHARE_BUDGET", ONE_BY_ONE)
    monkeypatch.setattr(shares, "num_cpus", lambda: 2)
    together, step = [], ImaginedDynamics.step

    def noted(self, *args):
        together.append(self.num_members)
        return step(self, *args)

    monkeypatch.setattr(ImaginedDynamics, "step", noted)
    jax.clear_caches()
    returns_of_shares(some_question(), TINY)
    assert set(together) == {1}


def test_a_share_is_traced_once_whoever_imagines_it(sharing, monkeypatch):
    traces, original = [], candidate_returns
    monkeypatch.setattr(
        shares, "candidate_returns", lambda *x, **y: traces.append(1) or original(*x, **y)
    )
    agent = make_agent(initial_std=0.4321, horizon=6)
    actions(agent, steps=4)
    assert len(traces) == 1


def test_a_deadline_planner_shares_its_iterations(sharing, monkeypatch):
    threads, original = set(), shares.returns_of_shares
    monkeypatch.setattr(
        search, "returns_of_shares", lambda *x: threads.add(len(original(*x))) or original(*x)
    )
    agent = make_agent()
    state = agent.init(1, key=jax.random.key(0))
    outcome = DeadlinePlanner(agent, 1000.0).act(state, OBS[:1], started=0.0, at_least=3)
    _, whole = jax.jit(lambda: act_in_one(agent, state, jnp.asarray(OBS[:1])))()
    assert outcome.complete
    assert threads == {3}
    np.testing.assert_allclose(outcome.decision.action, whole.action, atol=1e-5)


def test_what_is_not_shared(monkeypatch):
    steps = 3 * TINY.num_candidates * TINY.num_particles * TINY.horizon
    monkeypatch.setattr(shares, "num_cpus", lambda: 2)
    monkeypatch.setattr(shares, "LEAST", steps)
    assert worth_sharing(TINY, OBS)
    assert not worth_sharing(TINY, OBS[:2])  # too little work
    said = []
    jax.eval_shape(lambda obs: said.append(worth_sharing(TINY, obs)), OBS)
    assert said == [False]  # part of another program
    with Meeting() as meeting, meeting.take_seat():
        assert not worth_sharing(TINY, OBS)
    with monkeypatch.context() as patch:
        patch.setattr(shares, "num_cpus", lambda: 1)
        assert not worth_sharing(TINY, OBS)
    monkeypatch.setattr(jax, "device_count", lambda: 2)
    assert not worth_sharing(TINY, OBS)


@pytest.mark.parametrize("plans", [60, pytest.param(2_000, marks=pytest.mark.slow)])
def test_controllers_in_several_threads_share_the_cores_and_end(plans, sharing):
    wanted = [walk(seed, 3) for seed in range(3)]
    with ThreadPoolExecutor(3) as threads:
        found = [threads.submit(walk, seed, plans) for seed in range(3)]
    for seed, future in enumerate(found):
        np.testing.assert_array_equal(future.result(timeout=0)[:3], wanted[seed])


def walk(seed, steps):
    agent = make_agent()
    state, found = agent.init(1, key=jax.random.key(seed)), []
    for _ in range(steps):
        state, decision = agent.act(state, OBS[:1])
        found.append(np.asarray(decision.action))
    return np.stack(found)


def test_what_goes_wrong_in_a_share_is_told(sharing, monkeypatch):
    def fails(*args, **named):
        raise ZeroDivisionError

    monkeypatch.setattr(shares, "candidate_returns", fails)
    with pytest.raises(ZeroDivisionError):
        actions(make_agent(horizon=7))
