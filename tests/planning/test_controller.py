"""A controller in service: deadlines, bad observations, replaced actions, a long life."""

import dataclasses
import resource

import jax
import numpy as np
import pytest

import toys
from headway.config import CEMConfig, ICEMConfig
from headway.errors import ConfigError, PlanningError
from headway.models.statistics import Statistics
from headway.planning.agent import Agent
from headway.planning.controller import Controller
from headway.task import env_action, scaled_action

OBS = np.float32([0.8, -0.6])
BLIND = np.float32([np.nan, 0.0])
LONG = 1e7  # milliseconds


class Clock:
    """A clock that stands still, ticks at each reading, or jumps far ahead in a search."""

    def __init__(self):
        self.now, self.tick, self.left = 0.0, 0.0, np.inf

    def allow(self, iterations):
        """Jump ahead once so many iterations have begun: it is read once before, thrice in each."""
        self.left = 3 * iterations + 1

    def __call__(self):
        self.now += self.tick
        self.left -= 1
        if self.left < 0:
            self.now, self.left = self.now + 1e9, np.inf
        return self.now


@pytest.fixture
def clock():
    return Clock()


@pytest.fixture
def timed(clock):
    """A controller with a deadline that has a plan."""
    controller = Controller(toys.make_agent(), deadline_ms=LONG, clock=clock)
    controller.act(OBS)
    return controller


def plan_of(controller):
    """The rest of the last plan."""
    return np.asarray(controller._state.search.nominal[0])


@pytest.mark.parametrize(
    ("seconds", "iterations"), [(1, 0), (2.9, 0), (3, 1), (6, 2), (11.9, 3), (12, 4)]
)
def test_a_search_ends_in_time_and_not_earlier_than_need_be(seconds, iterations, clock):
    """A tick before each iteration, one for it, one after it and one for the end."""
    clock.tick = 1.0
    controller = Controller(toys.make_agent(), deadline_ms=1000.0 * seconds, clock=clock)
    clock.tick = 0.0
    controller.act(OBS)
    clock.tick = 1.0
    controller.act(OBS)
    assert controller.status.iterations == iterations
    assert controller.status.outcome == {0: "held", 4: "planned"}.get(iterations, "deadline")


def test_a_controller_says_how_its_last_action_was_found(clock):
    controller = Controller(toys.make_agent(), clock=clock)
    clock.tick = 0.002
    start = "Controller(2 numbers in, 2 out; cem, horizon 4"
    assert repr(controller) == f"{start})"
    controller.act(OBS)
    heads = " ".join(map(str, controller.heads))
    assert repr(controller) == f"{start}; planned in 2 ms, heads {heads})"


def test_slow_iterations_are_expected_to_stay_slow_but_a_hiccup_is_forgotten(clock):
    clock.tick = 1.0
    controller = Controller(toys.make_agent(), deadline_ms=9000.0, clock=clock)
    found = []
    for clock.tick in (1.0, 1.0, 4.0, 1.0, 100.0, 1.0, 1.0):
        controller.act(OBS)
        found.append(controller.status.iterations)
    assert found == [3, 3, 1, 1, 0, 0, 3]


def test_a_search_that_is_cut_off_answers_with_the_best_so_far(clock):
    controller = Controller(toys.make_agent(), deadline_ms=LONG, clock=clock)
    clock.allow(1)  # and one more, because there is no plan yet
    action = controller.act(OBS)
    assert (controller.status.outcome, controller.status.iterations) == ("deadline", 2)
    assert controller.status.reason == "time was up after 2 of 4 iterations"
    # An iteration's draws do not depend on how many there are.
    wanted = Controller(toys.make_agent(num_iterations=2)).act(OBS)
    np.testing.assert_allclose(action, wanted, atol=1e-5)


def test_without_time_for_any_iteration_the_last_plan_goes_on_until_it_ends(timed, clock):
    plan = plan_of(timed)
    for step in range(toys.TINY.horizon - 1):
        clock.allow(0)
        np.testing.assert_allclose(timed.act(OBS), plan[step], atol=1e-6)
        assert timed.status.outcome == "held"
        assert "fits the deadline" in timed.status.reason
    clock.allow(0)
    timed.act(OBS)  # nothing is left of the plan
    assert (timed.status.outcome, timed.status.iterations) == ("deadline", 1)


def test_a_deadline_in_which_no_iteration_fits_is_said_and_kept_while_a_plan_is_left(
    clock, monkeypatch
):
    iterate, takes = Agent.iterate, 0.3

    def slow(*args):
        clock.now += takes
        return iterate(*args)

    monkeypatch.setattr(Agent, "iterate", slow)
    with pytest.warns(UserWarning, match=r"iteration of the planner takes 300 here: one step in 4"):
        controller = Controller(toys.make_agent(), deadline_ms=50.0, clock=clock)
    found = []
    for _ in range(60):  # longer than any duration is remembered
        controller.act(OBS)
        found.append((controller.status.outcome, round(controller.status.seconds, 6)))
    assert found == 15 * [("deadline", 0.3), *3 * [("held", 0.0)]]
    takes = 0.01  # the machine is quick again
    for _ in range(3):
        controller.act(OBS)
    assert controller.status.outcome == "planned"


SERVICE = [  # what is seen, how many iterations fit, what comes of it, what was applied
    (OBS, 4, "planned"),
    (OBS, 4, "planned", [0.1, 0.2]),
    (OBS, 4, "planned", BLIND),
    (BLIND, 4, "held"),
    ([1e6, 0.0], 4, "planned"),  # unlike anything that was trained on
    *[(OBS, times, "deadline") for times in (1, 2, 3)],
    (OBS, 0, "held"),
    (BLIND, 4, "held"),
    (OBS, 0, "held"),
    (OBS, 0, "deadline"),  # nothing is left of the plan
    (BLIND, 4, "held"),
]


@pytest.mark.parametrize("optimizer", [CEMConfig(), ICEMConfig()], ids=str)
def test_with_a_deadline_nothing_is_compiled_in_service(optimizer, clock, caplog):
    jax.clear_caches()
    controller = Controller(toys.make_agent(optimizer=optimizer), deadline_ms=LONG, clock=clock)
    with jax.log_compiles(), caplog.at_level("WARNING", logger="jax"):
        for obs, times, outcome, *applied in SERVICE:
            if times < toys.TINY.num_iterations:
                clock.allow(times)
            controller.act(obs, applied_action=applied[0] if applied else None)
            assert controller.status.outcome == outcome
        controller.reset()
        with pytest.raises(PlanningError):
            controller.act(BLIND)
        controller.act(OBS)
    said = [record.getMessage()[:99] for record in caplog.records]
    assert [message for message in said if "XLA" in message] == []  # shapes may be traced


@pytest.mark.parametrize(("bad", "deadline_ms"), [(np.nan, None), (np.inf, LONG), (1e300, LONG)])
def test_an_observation_that_is_not_finite_is_answered_with_the_last_plan(bad, deadline_ms):
    controller = Controller(toys.make_agent(), deadline_ms=deadline_ms)
    with pytest.raises(PlanningError, match=r"obs\[0\] is nan"):
        controller.act(BLIND)
    obs = OBS + controller.act(OBS)
    plan = plan_of(controller)
    for step in range(toys.TINY.horizon - 1):
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


def test_a_plan_without_finite_returns_is_held_and_said():
    agent = toys.make_agent()
    controller = Controller(agent)
    controller.act(OBS)
    plan = plan_of(controller)
    broken = jax.tree.map(lambda x: x * np.nan, agent.model)
    controller.agent = dataclasses.replace(agent, model=broken)
    np.testing.assert_allclose(controller.act(OBS), plan[0], atol=1e-6)
    assert controller.status.outcome == "held"
    assert controller.status.reason.startswith("none of 4 iterations")


def test_an_action_that_was_never_returned_is_not_learned_from():
    agent = toys.make_agent()
    controller = Controller(agent)
    controller.agent = dataclasses.replace(
        agent, model=jax.tree.map(lambda x: x * np.nan, agent.model)
    )
    with pytest.raises(PlanningError, match="finite return"):
        controller.act(OBS)
    controller.agent = agent
    controller.act(OBS)
    assert int(controller._state.belief.recent.count[0]) == 0


def test_an_iteration_that_failed_is_no_failed_plan(monkeypatch):
    act = Agent.act

    def fails_once(*args):
        state, decision = act(*args)
        return state, decision._replace(failures=1 + decision.failures)

    monkeypatch.setattr(Agent, "act", fails_once)
    controller = Controller(toys.make_agent())
    controller.act(OBS)
    assert (controller.status.outcome, controller.status.iterations) == ("planned", 4)


@pytest.mark.parametrize("obs", [np.zeros(3), np.zeros((1, 2)), [1.0, [2.0]], "x"], ids=str)
def test_an_observation_of_another_shape_is_an_error(obs):
    with pytest.raises(ConfigError, match=r"obs .*allowed"):
        Controller(toys.make_agent()).act(obs)


@pytest.mark.parametrize("deadline_ms", [0.0, float("nan"), float("inf")])
def test_a_deadline_is_a_time(deadline_ms):
    with pytest.raises(ConfigError, match="deadline_ms is"):
        Controller(toys.make_agent(), deadline_ms=deadline_ms)


def test_observations_unlike_the_training_data_are_named():
    trajectories = [toys.random_trajectory(50, seed=n, constant=True) for n in range(4)]
    for trajectory in trajectories:
        trajectory.obs[:, 1] = 0.5
    statistics = Statistics.fit(toys.POINT, trajectories, 3)
    mean, std = (float(x[0]) for x in (statistics.features.mean, statistics.features.std))
    agent = toys.make_agent(toys.small_model(), statistics=statistics)

    def warnings_of(obs, **settings):
        controller = Controller(agent, **settings)
        controller.act(obs)
        assert controller.status.outcome == "planned"
        return controller.status.warnings

    assert warnings_of([mean + 9.9 * std, 0.5]) == ()
    first, second = warnings_of([mean - 12 * std, 0.4])
    assert first == "feature 0 is 12 standard deviations from its mean in training, allowed: 10"
    assert second.startswith("feature 1 is off by 0.1 from 0.5, its only value")
    assert warnings_of([mean - 12 * std, 0.4], max_deviations=None) == ()


def memory() -> int:
    """Bytes that the process has held at most."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024


@pytest.mark.parametrize(
    ("deadline_ms", "steps"),
    [
        (None, 1000),
        *(pytest.param(*case, marks=pytest.mark.slow) for case in [(LONG, 400), (None, 10_000)]),
    ],
)
def test_many_steps_take_no_more_memory(deadline_ms, steps):
    controller = Controller(toys.make_agent(num_iterations=2), deadline_ms=deadline_ms)
    rng = np.random.default_rng(0)

    def serve(steps):
        for step in range(steps):
            if step % 100 == 99:
                controller.reset()
            controller.act(rng.normal(size=2) if step % 7 or step % 100 in (0, 99) else [np.nan, 0])

    serve(300)
    arrays, before = len(jax.live_arrays()), memory()
    serve(steps)
    assert len(jax.live_arrays()) <= arrays + 5
    assert memory() - before < 8 * 2**20


# Actions that a safety layer or an operator replaced.


class Valves(toys.PointTask):
    """The same point, pushed in other units."""

    action_low = (-2.0, 0.0)
    action_high = (2.0, 40.0)


TASK = Valves()


@pytest.fixture
def valves():
    return Controller(toys.make_agent(selection_length=3, task=TASK))


@pytest.mark.parametrize(("told", "heads"), [(True, [0, 1]), (False, [1, 0])])
def test_heads_are_chosen_by_what_was_applied(told, heads, valves):
    obs, applied = OBS, None
    for _ in range(4):
        asked = valves.act(obs, applied_action=applied if told else None)
        applied = env_action(TASK, -scaled_action(TASK, asked))  # who wants the opposite
        obs = obs + scaled_action(TASK, applied)
    valves.act(obs, applied_action=applied if told else None)
    assert np.asarray(valves.heads).tolist() == heads
    newest = valves._state.belief.recent.action[0, -1]
    wanted = scaled_action(TASK, applied if told else asked)
    np.testing.assert_allclose(newest, wanted, atol=1e-6)
    assert np.abs(wanted).min() > 1e-3


def test_nothing_is_learned_from_a_step_whose_action_is_not_known(valves):
    valves.act(OBS)
    valves.act(OBS, applied_action=np.array([0.0, np.nan]))
    assert int(valves._state.belief.recent.count[0]) == 0
    valves.act(OBS)
    assert int(valves._state.belief.recent.count[0]) == 1
    assert np.isfinite(np.asarray(valves._state.belief.recent.action)).all()


@pytest.mark.parametrize(
    ("applied", "message"),
    [
        ([1.0], r"applied_action has shape \(1,\), allowed: \(2,\); pass one action in"),
        ([[0.0, 0.0]], r"applied_action has shape \(1, 2\)"),
        ("left", "applied_action is 'left', allowed: 2 numbers"),
        ([0.0, 44.1], r"applied_action\[1\] is 44.1, allowed: from 0 to 40, and 4 beyond"),
        ([-2.5, 0.0], r"applied_action\[0\] is -2.5, allowed: from -2 to 2"),
    ],
)
def test_what_cannot_be_an_action_is_an_error_and_changes_nothing(applied, message, valves):
    valves.act(OBS)
    before = valves._state
    with pytest.raises(ConfigError, match=message) as caught:
        valves.act(OBS, applied_action=applied)
    assert "\n" not in str(caught.value)
    assert valves._state is before
    valves.act(OBS, applied_action=[2.3, -3.9])  # as a sensor may have it
    newest = valves._state.belief.recent.action[0, -1]
    np.testing.assert_allclose(newest, [1.15, -1.195], atol=1e-6)


def test_random_actions_have_no_deadline_but_their_applied_actions_are_checked():
    agent = Agent(None, TASK, toys.TINY)
    with pytest.raises(ConfigError, match=r"is 50, but random makes no plan .*allowed: None"):
        Controller(agent, deadline_ms=50.0)
    controller = Controller(agent)
    controller.act(OBS, applied_action=[0.0, 1.0])
    with pytest.raises(ConfigError, match="applied_action has shape"):
        controller.act(OBS, applied_action=[0.0])
