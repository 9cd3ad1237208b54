"""A controller in service: deadlines, bad observations, plans that fail, a long life."""

import dataclasses
import resource

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import toys
from headway.config import CEMConfig, ICEMConfig, MPPIConfig, PlannerConfig, RandomShootingConfig
from headway.errors import ConfigError, PlanningError
from headway.models.multi_headed import Statistics
from headway.planning import agent as agent_module
from headway.planning.agent import Agent
from headway.planning.controller import Controller
from headway.planning.deadline import DeadlinePlanner
from headway.planning.optimizers import make_optimizer
from headway.planning.rollouts import candidate_returns

TINY = PlannerConfig(
    horizon=4,
    num_candidates=60,
    optimizer=CEMConfig(num_elites=10),
    num_iterations=4,
    num_particles=2,
    selection_length=2,
)
UP_DOWN = toys.linear_model([[np.eye(2), -np.eye(2)], [-np.eye(2), np.eye(2)]])
OBS = np.float32([0.8, -0.6])
BLIND = np.float32([np.nan, 0.0])
LONG = 1e7  # milliseconds


def make_agent(model=UP_DOWN, *, statistics=None, **settings) -> Agent:
    return toys.make_agent(model, dataclasses.replace(TINY, **settings), statistics=statistics)


def play(controller, steps, obs=OBS):
    """Every action on `obs' = obs + action`, and the state it ends in."""
    actions = []
    for _ in range(steps):
        actions.append(controller.act(obs))
        obs = obs + actions[-1]
    return np.stack(actions), obs


OPTIMIZERS = [
    {},
    {"optimizer": ICEMConfig()},
    {"optimizer": MPPIConfig()},
    {"optimizer": RandomShootingConfig()},
]


@pytest.mark.parametrize("settings", OPTIMIZERS, ids=str)
def test_a_deadline_that_is_long_enough_changes_nothing(settings):
    agent = make_agent(**settings)
    wanted, _ = play(Controller(agent), 3)
    controller = Controller(agent, deadline_ms=LONG)
    got, _ = play(controller, 3)
    np.testing.assert_allclose(got, wanted, atol=1e-4)
    assert controller.status is not None
    assert controller.status.outcome == "planned"
    assert controller.status.reason == ""


class Work:
    """A clock that stands still but for the parts of a plan, and the planner that it times."""

    def __init__(self, agent, seconds, costs=(1.0, 2.0, 0.5)):
        self.now = 0.0
        self.planner = DeadlinePlanner(agent, seconds, lambda: self.now)
        self.costs = dict(zip(("begin", "iterate", "end"), costs, strict=True))
        parts = self.planner._parts
        self.planner._parts = {name: self.costly(name, parts[name]) for name in parts}
        self.planner.warm_up()

    def costly(self, name, part):
        def run(*args):
            self.now += self.costs[name]
            return part(*args)

        return run


@pytest.mark.parametrize(
    ("seconds", "iterations"), [(1.0, 0), (3.4, 0), (3.6, 1), (5.6, 2), (9.4, 3), (9.5, 4)]
)
def test_a_search_ends_in_time_and_not_earlier_than_need_be(seconds, iterations):
    agent = make_agent()
    work = Work(agent, seconds)
    started = work.now
    outcome = work.planner.act(agent.init(1, key=jax.random.key(0)), OBS[None], started)
    assert outcome.iterations == iterations
    assert outcome.complete == (iterations == 4)
    assert work.now - started <= max(seconds, 1.5)  # what comes before and after is never left out


def test_iterations_that_became_slow_are_expected_to_stay_so():
    agent = make_agent()
    work = Work(agent, 8.0)
    state = agent.init(1, key=jax.random.key(0))
    assert work.planner.act(state, OBS[None], work.now).iterations == 3
    work.costs["iterate"] = 4.0
    assert work.planner.act(state, OBS[None], work.now).iterations == 1
    work.costs["iterate"] = 2.0
    assert work.planner.act(state, OBS[None], work.now).iterations == 2


def test_a_search_that_is_cut_off_answers_with_the_best_so_far():
    agent = make_agent()
    state = agent.init(1, key=jax.random.key(0))
    work = Work(agent, 5.6)
    outcome = work.planner.act(state, OBS[None], work.now)
    # The same draws, those of the first two of four iterations, by hand.
    obs = jnp.asarray(OBS[None])
    step = eqx.filter_jit(agent_module.observe)(agent, state, obs)

    def score(candidates, key):
        args = step.dynamics, agent.task, obs, candidates
        return candidate_returns(*args, planner=agent.planner, key=key)

    optimizer = make_optimizer(agent.planner)
    search = optimizer.begin(state.search)
    for key in jax.random.split(step.plan_key, 4)[:2]:
        search = jax.jit(lambda search, key: optimizer.iterate(score, search, key))(search, key)
    wanted = optimizer.end(search).actions[:, 0]
    np.testing.assert_allclose(outcome.decision.action, wanted, atol=1e-5)
    assert int(outcome.decision.evaluations[0]) == 2 * TINY.num_candidates


def test_the_status_says_that_time_was_up(monkeypatch):
    controller = Controller(make_agent(), deadline_ms=LONG)
    assert controller._deadline is not None
    fits = iter([True, False])  # the first iteration, with no plan yet, is made in any case
    monkeypatch.setattr(controller._deadline, "_fits", lambda until: next(fits))
    controller.act(OBS)
    status = controller.status
    assert status is not None
    assert (status.outcome, status.iterations) == ("deadline", 2)
    assert status.reason == "time was up after 2 of 4 iterations"
    assert status.seconds > 0


def test_without_time_for_any_iteration_the_last_plan_goes_on_until_it_ends(monkeypatch):
    agent = make_agent()
    controller = Controller(agent, deadline_ms=LONG)
    action = controller.act(OBS)
    assert controller._deadline is not None
    plan = np.asarray(controller._state.search.guess[0])
    monkeypatch.setattr(controller._deadline, "_fits", lambda until: False)
    obs = OBS + action
    for step in range(TINY.horizon - 1):
        action = controller.act(obs)
        assert controller.status.outcome == "held"
        assert "fits the deadline" in controller.status.reason
        np.testing.assert_allclose(action, plan[step], atol=1e-6)
    controller.act(obs)  # nothing is left of the plan
    assert controller.status.outcome == "deadline"
    assert controller.status.iterations == 1
    controller.act(obs)
    assert controller.status.outcome == "held"


SERVICE = [  # what is seen, how often another iteration fits, what comes of it, what was applied
    (OBS, 4, "planned"),
    (OBS, 4, "planned"),
    (OBS, 4, "planned", [0.1, 0.2]),
    (OBS, 4, "planned", BLIND),
    (BLIND, 0, "held"),
    ([1e6, 0.0], 4, "planned"),  # unlike anything that was trained on
    *[(OBS, times, "deadline") for times in (1, 2, 3)],
    (OBS, 0, "held"),
    (BLIND, 0, "held"),
    (OBS, 0, "held"),
    (OBS, 0, "deadline"),  # nothing is left of the plan
    (BLIND, 0, "held"),
]


@pytest.mark.parametrize("settings", [{}, {"optimizer": ICEMConfig()}], ids=str)
def test_with_a_deadline_nothing_is_compiled_in_service(settings, monkeypatch, caplog):
    jax.clear_caches()
    controller = Controller(make_agent(**settings), deadline_ms=LONG)
    assert controller._deadline is not None
    with jax.log_compiles(), caplog.at_level("WARNING", logger="jax"):
        for obs, times, outcome, *rest in SERVICE:
            applied = rest[0] if rest else None
            clock = iter([True] * times)
            monkeypatch.setattr(controller._deadline, "_fits", lambda _, c=clock: next(c, False))
            controller.act(obs, applied_action=applied)
            assert controller.status is not None
            assert controller.status.outcome == outcome
        controller.reset()
        with pytest.raises(PlanningError):
            controller.act(BLIND)
        controller.act(OBS)
    assert [record.getMessage()[:99] for record in caplog.records] == []


@pytest.mark.parametrize(("part", "iterations"), [("iterate", 1), ("end", 3)])
def test_a_hiccup_costs_one_step(part, iterations):
    agent = make_agent()
    work = Work(agent, 8.0)
    state = agent.init(1, key=jax.random.key(0))
    usual = work.costs[part]
    work.costs[part] = 100.0
    assert work.planner.act(state, OBS[None], work.now).iterations == iterations
    work.costs[part] = usual
    assert work.planner.act(state, OBS[None], work.now).iterations == 0
    assert work.planner.act(state, OBS[None], work.now).iterations == 3


@pytest.mark.parametrize("bad", [np.nan, np.inf, 1e300])
@pytest.mark.parametrize("deadline_ms", [None, LONG])
def test_an_observation_that_is_not_finite_is_answered_with_the_last_plan(bad, deadline_ms):
    controller = Controller(make_agent(), deadline_ms=deadline_ms)
    action = controller.act(OBS)
    obs = OBS + action
    plan = np.asarray(controller._state.search.guess[0])
    for step in range(TINY.horizon - 1):
        action = controller.act(np.array([obs[0], bad]))
        np.testing.assert_allclose(action, plan[step], atol=1e-6)
        assert controller.status.outcome == "held"
        assert "obs[1] is" in controller.status.reason
        obs = obs + action
    with pytest.raises(PlanningError, match=r"obs\[1\] is .* no earlier plan is left"):
        controller.act(np.array([obs[0], bad]))
    controller.act(obs)  # the sensor is back
    assert controller.status.outcome == "planned"
    # What happened unseen is not taken for a transition.
    assert int(controller._state.belief.recent.count[0]) == 0
    controller.act(obs)
    assert int(controller._state.belief.recent.count[0]) == 1
    assert np.isfinite(np.asarray(controller._state.belief.recent.obs)).all()


def test_the_first_observation_must_be_finite():
    with pytest.raises(PlanningError, match=r"obs\[0\] is nan"):
        Controller(make_agent()).act(np.array([np.nan, 0.0]))


def test_a_plan_without_finite_returns_is_held_and_said():
    agent = make_agent()
    controller = Controller(agent)
    controller.act(OBS)
    plan = np.asarray(controller._state.search.guess[0])
    broken = jax.tree.map(lambda x: x * np.nan, agent.model)
    controller.agent = dataclasses.replace(agent, model=broken)
    np.testing.assert_allclose(controller.act(OBS), plan[0], atol=1e-6)
    assert controller.status.outcome == "held"
    assert controller.status.reason.startswith("none of 4 iterations")


@pytest.mark.parametrize(
    "obs", [np.zeros(3), np.zeros((1, 2)), np.zeros(()), [1.0, [2.0]], "x"], ids=str
)
def test_an_observation_of_another_shape_is_an_error(obs):
    with pytest.raises(ConfigError, match=r"obs .*allowed"):
        Controller(make_agent()).act(obs)


@pytest.mark.parametrize("deadline_ms", [0.0, -1.0, float("nan"), float("inf")])
def test_a_deadline_is_a_time(deadline_ms):
    with pytest.raises(ConfigError, match="deadline_ms is"):
        Controller(make_agent(), deadline_ms=deadline_ms)


def test_observations_unlike_the_training_data_are_named():
    trajectories = [toys.random_trajectory(50, seed=n, constant=True) for n in range(4)]
    for trajectory in trajectories:
        trajectory.obs[:, 1] = 0.5
    statistics = Statistics.fit(toys.POINT, trajectories, 3)
    controller = Controller(make_agent(toys.small_model(), statistics=statistics))
    mean, std = (float(x[0]) for x in (statistics.features.mean, statistics.features.std))
    controller.act(np.array([mean + 9.9 * std, 0.5]))
    assert controller.status.warnings == ()
    controller.act(np.array([mean - 12 * std, 0.4]))
    first, second = controller.status.warnings
    assert first == "feature 0 is 12 standard deviations from its mean in training, allowed: 10"
    assert second.startswith("feature 1 is off by 0.1 from 0.5, its only value")
    assert controller.status.outcome == "planned"
    quiet = Controller(controller.agent, max_deviations=None)
    quiet.act(np.array([mean - 12 * std, 0.4]))
    assert quiet.status.warnings == ()


@pytest.mark.parametrize(("deadline_ms", "steps"), [(None, 1000), (LONG, 400)])
def test_many_steps_trace_once_and_take_no_more_memory(deadline_ms, steps, monkeypatch):
    traces = []
    original = agent_module.observe
    monkeypatch.setattr(agent_module, "observe", lambda *x: traces.append(1) or original(*x))
    # A setting that no other test compiled.
    agent = make_agent(
        num_iterations=2, optimizer=CEMConfig(initial_std=0.3217 if deadline_ms else 0.3218)
    )
    controller = Controller(agent, deadline_ms=deadline_ms)
    rng = np.random.default_rng(0)

    def serve(steps):
        for step in range(steps):
            if step % 100 == 99:
                controller.reset()
            controller.act(rng.normal(size=2) if step % 7 or step % 100 in (0, 99) else [np.nan, 0])

    serve(300)
    before = len(traces), len(jax.live_arrays()), memory()
    serve(steps)
    after = len(traces), len(jax.live_arrays()), memory()
    assert before[0] == after[0] == 1
    assert after[1] <= before[1] + 5
    assert after[2] - before[2] < 8 * 2**20


def memory() -> int:
    """Bytes that the process has held at most."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024
