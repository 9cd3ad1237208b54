"""Cores that share the candidates of a plan choose what one program would choose."""

import dataclasses
import threading
from concurrent.futures import ThreadPoolExecutor

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import toys
from headway.config import CEMConfig, ICEMConfig, MPPIConfig, RandomShootingConfig
from headway.planning import returns, search, shares
from headway.planning.deadline import DeadlinePlanner
from headway.planning.imagination import ImaginedDynamics
from headway.planning.returns import RolloutSettings, candidate_returns
from headway.planning.search import act_in_one
from headway.planning.shares import Question, joined, num_shares, returns_of_shares
from planning.test_devices import TINY, actions, make_agent, printed_by, python

OBS = np.ones((3, 2), np.float32)
ONE_BY_ONE = 1
"""A budget in which nothing fits."""


@pytest.fixture
def sharing(monkeypatch):
    """Plans of any size are shared by three cores."""
    monkeypatch.setattr(shares, "LEAST", 1)
    monkeypatch.setattr(shares, "num_cpus", lambda: 3)


@pytest.mark.parametrize(
    "settings",
    [
        {},
        {"num_candidates": 41},
        {"precision": "bfloat16"},
        {"particle_noise": "shared"},
        {"optimizer": ICEMConfig(num_elites=4)},
        {"optimizer": MPPIConfig()},
        {"optimizer": RandomShootingConfig()},
    ],
    ids=str,
)
def test_cores_that_share_a_plan_choose_the_actions_of_one_program(settings, sharing, monkeypatch):
    agent = make_agent(**settings)
    shared = actions(agent)
    monkeypatch.setattr(shares, "LEAST", np.inf)
    np.testing.assert_allclose(shared, actions(agent), atol=1e-5)


@pytest.mark.parametrize(
    ("cores", "budget", "settings", "kind"),
    [
        (2, ONE_BY_ONE, {"particle_noise": "shared"}, "head"),
        (4, returns.SHARE_BUDGET, {"particle_noise": "shared"}, "last-hidden"),
        (7, returns.SHARE_BUDGET, {}, "head"),
        (40, ONE_BY_ONE, {}, "last-hidden"),
    ],
)
def test_shares_have_the_returns_of_the_whole(cores, budget, settings, kind, monkeypatch):
    monkeypatch.setattr(returns, "SHARE_BUDGET", budget)
    monkeypatch.setattr(shares, "_COMPILED", compiled_anew())  # for this budget
    question, planner = some_question(kind), make_agent(**settings).planner
    found = joined(returns_of_shares(question, planner, cores), 7)
    dynamics, task, obs, candidates, key = question
    rollouts = RolloutSettings.of(planner, 2)
    whole = candidate_returns(dynamics, task, obs, candidates, settings=rollouts, key=key)
    np.testing.assert_allclose(found, whole, rtol=1e-5)
    assert len(np.unique(whole)) == whole.size


def compiled_anew():
    """Programs that no other test has traced, under another budget or without a patch."""

    def share_returns(*args, **named):
        return shares._share_returns(*args, **named)

    return {"float32": eqx.filter_jit(share_returns)}


def some_question(kind="head"):
    rng = np.random.default_rng(3)
    heads, context = jnp.asarray(rng.integers(0, 2, (3, 2, 1))), rng.normal(size=(2, 3, 3))
    place = kind if kind == "last-hidden" else "head"
    model = toys.small_model(config=dataclasses.replace(toys.SMALL, context_at=place))
    dynamics = ImaginedDynamics.fold(
        model, toys.identity_statistics(), heads, jnp.asarray(context, jnp.float32)
    )
    candidates = jnp.asarray(rng.uniform(-1, 1, (3, 7, 4, 2)), jnp.float32)
    return Question(dynamics, toys.POINT, jnp.asarray(OBS), candidates, jax.random.key(1))


def test_one_by_one_each_member_imagines_alone(monkeypatch):
    monkeypatch.setattr(returns, "SHARE_BUDGET", ONE_BY_ONE)
    monkeypatch.setattr(shares, "_COMPILED", compiled_anew())
    together, step = [], ImaginedDynamics.step

    def noted(self, *args):
        together.append(self.num_members)
        return step(self, *args)

    monkeypatch.setattr(ImaginedDynamics, "step", noted)
    returns_of_shares(some_question(), TINY, 2)
    assert set(together) == {1}


def test_a_share_is_traced_once_whoever_imagines_it(sharing, monkeypatch):
    traces, original = [], candidate_returns
    monkeypatch.setattr(
        shares, "candidate_returns", lambda *x, **y: traces.append(1) or original(*x, **y)
    )
    agent = make_agent(optimizer=CEMConfig(initial_std=0.4321), horizon=6)
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


def test_into_how_many_shares_a_plan_is_divided(monkeypatch):
    steps = TINY.num_candidates * TINY.num_particles * TINY.horizon
    monkeypatch.setattr(shares, "num_cpus", lambda: 4)
    monkeypatch.setattr(shares, "LEAST", steps)
    assert [num_shares(TINY, num_envs) for num_envs in (1, 2, 3, 4, 5, 100)] == [1, 2, 3, 4, 4, 4]
    monkeypatch.setattr(jax, "device_count", lambda: 2)
    assert num_shares(TINY, 3) == 1


def test_a_step_that_is_part_of_another_program_is_one_program(sharing):
    agent = make_agent()
    state = agent.init(1, key=jax.random.key(0))
    keys = jax.random.split(jax.random.key(1), 2)

    def action(key):
        return agent.act(state._replace(key=key), OBS[:1])[1].action

    found = jax.vmap(action)(keys)
    np.testing.assert_allclose(found, [action(key) for key in keys], atol=1e-5)


MANY_THREADS = """
import sys, numpy as np
from concurrent.futures import ThreadPoolExecutor
from headway.planning import shares
from planning.test_shares import walk
shares.LEAST, shares.num_cpus = 1, lambda: 3
wanted = [walk(seed, 3) for seed in range(3)]
with ThreadPoolExecutor(3) as threads:
    found = threads.map(walk, range(3), [int(sys.argv[1])] * 3)
print([np.array_equal(some[:3], all) for some, all in zip(found, wanted)])
"""


@pytest.mark.parametrize("plans", [60, pytest.param(2_000, marks=pytest.mark.slow)])
def test_controllers_in_several_threads_share_the_cores_and_end(plans):
    out = printed_by(python(MANY_THREADS, str(plans)), seconds=max(120, plans))
    assert out.strip() == "[True, True, True]"


def walk(seed, steps):
    agent = make_agent()
    state, found = agent.init(1, key=jax.random.key(seed)), []
    for _ in range(steps):
        state, decision = agent.act(state, OBS[:1])
        found.append(np.asarray(decision.action))
    return np.stack(found)


AFTER_THE_MAIN_THREAD = """
import threading
from headway.planning import shares
from planning.test_shares import walk
shares.LEAST, shares.num_cpus = 1, lambda: 3
walk(0, 1)
def late():
    threading.main_thread().join()
    print(walk(0, 2).shape)
threading.Thread(target=late).start()
"""


def test_a_controller_may_outlive_the_main_thread():
    assert printed_by(python(AFTER_THE_MAIN_THREAD)).strip() == "(2, 1, 2)"


def test_a_plan_does_not_wait_for_threads_that_are_busy(sharing, monkeypatch):
    agent, free = make_agent(), threading.Event()
    actions(agent)
    with ThreadPoolExecutor(1) as busy:
        monkeypatch.setattr(shares, "_threads", lambda: busy)
        busy.submit(free.wait, 60)
        actions(agent)
        assert not free.is_set()
        free.set()


def test_what_goes_wrong_in_another_thread_is_told(sharing, monkeypatch):
    original, together = shares._COMPILED["float32"], threading.Barrier(3)

    def fails_elsewhere(*args, **named):
        together.wait(60)
        if threading.current_thread() is not threading.main_thread():
            raise ZeroDivisionError
        return original(*args, **named)

    monkeypatch.setattr(shares, "_COMPILED", {"float32": fails_elsewhere})
    with ThreadPoolExecutor(2) as threads:
        monkeypatch.setattr(shares, "_threads", lambda: threads)
        with pytest.raises(ZeroDivisionError):
            actions(make_agent())
