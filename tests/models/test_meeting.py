"""Runs that wait for each other, with functions small enough to follow by hand."""

import functools
import sys
import threading
from concurrent.futures import ThreadPoolExecutor, wait
from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from headway.config import FittingConfig, PlannerConfig
from headway.models import meeting as meetings
from headway.models.compilation import jit_networks
from headway.models.fitting import FitSetup, fit_epoch, make_data
from headway.models.meeting import Meeting, MeetingClosedError, Program, seeds_at_once
from headway.planning import devices
from headway.planning.agent import Agent

sys.path.append(str(Path(__file__).parent.parent))
from toys import POINT, SMALL, lay_out, odd_statistics, random_trajectory, small_model


@jit_networks
def walk(state, step, *, times=1, key):
    return state + times * step + jax.random.uniform(key), {"step": 2 * step}


def side_by_side(meeting, *runs):
    """Run every function in a thread with a seat of its own; returns the futures, all over."""
    seats = [meeting.take_seat() for _ in runs]

    def sit(run, seat):
        with seat:
            return run(seat)

    with ThreadPoolExecutor(len(runs)) as pool:
        return [pool.submit(sit, run, seat) for run, seat in zip(runs, seats, strict=True)]


@pytest.fixture
def groups(monkeypatch):
    """How many calls were computed together each time, 1 for one by itself."""
    sizes, whole = [], Meeting._results

    def results(self, calls, stacks):
        sizes.append(len(calls))
        return whole(self, calls, stacks)

    monkeypatch.setattr(Meeting, "_results", results)
    return sizes


def walker(seed, steps=3, times=1):
    def run(seat):
        state, step = jnp.full(4, float(seed)), jnp.asarray(0.5)
        for key in jax.random.split(jax.random.key(seed), steps):
            state, found = walk(state, step, times=times, key=key)
        return state, found

    return run


def assert_same(future, run):
    expected = run(None)  # outside of a meeting
    jax.tree.map(np.testing.assert_array_equal, future.result(), expected)


def test_calls_that_are_alike_are_computed_together(groups):
    runs = [walker(seed) for seed in range(3)]
    found = side_by_side(Meeting(), *runs)
    assert groups == [3, 3, 3]
    for future, run in zip(found, runs, strict=True):
        assert_same(future, run)


@pytest.mark.parametrize(("most", "wanted"), [(2, [2, 2, 1] * 3), (3, [3, 2] * 3)])
def test_a_cpu_computes_a_few_at_once(groups, monkeypatch, most, wanted):
    monkeypatch.setattr(meetings, "MOST_ON_CPU", most)
    runs = [walker(seed) for seed in range(5)]
    found = side_by_side(Meeting(), *runs)
    assert groups == wanted
    for future, run in zip(found, runs, strict=True):
        assert_same(future, run)


def test_calls_that_differ_in_more_than_numbers_are_computed_apart(groups):
    runs = [walker(0), walker(1, times=2), walker(2)]
    found = side_by_side(Meeting(), *runs)
    assert sorted(groups) == [1, 1, 1, 2, 2, 2]
    for future, run in zip(found, runs, strict=True):
        assert_same(future, run)


def test_nobody_waits_for_a_run_that_is_over_or_failed(groups):
    def failing(seat):
        walker(2, steps=1)(seat)
        raise ZeroDivisionError

    runs = [walker(0), walker(1, steps=2), failing]
    found = side_by_side(Meeting(), *runs)
    assert groups == [3, 2, 1]
    assert_same(found[0], runs[0])
    assert isinstance(found[2].exception(), ZeroDivisionError)


def test_a_run_that_is_ahead_waits_for_the_others(groups):
    order = []

    def noted(seed, positions):
        def run(seat):
            for position in positions:
                seat.move(position)
                walker(seed, steps=1)(seat)
                order.append((seed, position))

        return run

    side_by_side(Meeting(), noted(0, [(0, 1), (1, 0)]), noted(1, [(0, 0), (0, 1), (1, 0)]))
    assert groups == [1, 2, 2]
    assert order[0] == (1, (0, 0))


def test_what_goes_wrong_in_the_program_is_told_to_each():
    @jit_networks
    def misshapen(x):
        return x @ x

    found = side_by_side(Meeting(), *[lambda seat: misshapen(jnp.ones((2, 3)))] * 2)
    assert all(isinstance(future.exception(), TypeError) for future in found)


def test_calls_that_cannot_be_compared_are_an_error_for_each():
    class Odd:
        __hash__ = None

    meeting = Meeting()
    seats = [meeting.take_seat() for _ in range(2)]

    def sit(seat):
        with seat:
            return walk(jnp.ones(4), Odd(), key=jax.random.key(0))

    pool = ThreadPoolExecutor(2)
    found = [pool.submit(sit, seat) for seat in seats]
    with meeting:  # frees who still waits then
        wait(found, timeout=30)
    pool.shutdown()
    assert all("unhashable type: 'Odd'" in str(future.exception()) for future in found)


def test_a_closed_meeting_stops_those_who_wait():
    meeting = Meeting()
    absent, seat = meeting.take_seat(), meeting.take_seat()
    waiting = threading.Event()

    def run():
        with seat:
            waiting.set()
            walker(0)(seat)

    with ThreadPoolExecutor(1) as pool:
        with meeting:
            future = pool.submit(run)
            waiting.wait()
        assert isinstance(future.exception(), MeetingClosedError)
    assert absent.call is None


@pytest.mark.parametrize("groups", [1, 2])
def test_what_stays_the_same_is_stacked_once(monkeypatch, groups):
    monkeypatch.setattr(meetings, "MOST_ON_CPU", 2)
    stacked, whole = [], meetings.stack

    def stack(trees):
        stacked.append(trees[0])
        return whole(trees)

    monkeypatch.setattr(meetings, "stack", stack)
    side_by_side(Meeting(), *[walker(seed) for seed in range(2 * groups)])
    numbers = [x for x in stacked if eqx.is_array(x) and jnp.issubdtype(x.dtype, jnp.floating)]
    assert [x.shape for x in numbers] == [(4,), ()] * groups  # state and step, never again
    keys = [x for x in stacked if eqx.is_array(x) and not jnp.issubdtype(x.dtype, jnp.floating)]
    assert len(keys) == 3 * groups  # a new one every time


def test_memory_is_shared_by_the_seeds(monkeypatch):
    monkeypatch.setattr(devices, "activation_budget", lambda: 600)
    found = []

    def look(x):
        found.append((seeds_at_once(), devices.environments_at_once(6, 100)))
        return x

    program = Program(look, dict)
    program.alone(jnp.zeros(2))
    program.together(((jnp.zeros((3, 2)),), {}))
    assert found == [(1, 6), (3, 2)]


@pytest.mark.slow
@pytest.mark.parametrize("precision", ["float32", "bfloat16"])
def test_a_fit_and_a_plan_of_several_seeds_equal_those_of_each(precision):
    """The data differ in length, so some seeds make more updates than others."""
    fitting = FittingConfig(batch_size=8, future_length=2, segment_length=3, precision=precision)
    setup = FitSetup(POINT, fitting, SMALL.history_length)
    planner = PlannerConfig(
        horizon=3, num_candidates=8, num_elites=3, num_iterations=3, num_particles=2,
    )  # fmt: skip

    def run(seed):
        def fit_and_plan(seat):
            lengths = (5, 4) if seed == 1 else (7, 9)
            trajectories = [random_trajectory(n, 10 * seed + n) for n in lengths]
            episodes, samples = lay_out(trajectories, max_length=10, sample_capacity=40)
            key, statistics = jax.random.key(seed), odd_statistics(seed=seed)
            data = make_data(episodes, samples, statistics, fitting, num_members=2, key=key)
            state = setup.init(small_model(seed))
            state, stats = fit_epoch(state, setup, data, independent=False, key=key)
            agent = Agent(state.model, statistics, POINT, planner, SMALL.history_length)
            remembered, plans = agent.init(2, key=key), []
            for step in range(3):
                remembered, decision = agent.act(remembered, jnp.full((2, 2), 0.1 * step))
                plans.append(decision)
            return state, stats, plans

        return fit_and_plan

    runs = [run(seed) for seed in range(3)]
    for future, alone in zip(side_by_side(Meeting(), *runs), runs, strict=True):
        expected = alone(None)
        close = functools.partial(np.testing.assert_allclose, rtol=1e-4, atol=1e-5)
        jax.tree.map(close, future.result(), expected)
        assert expected[1].updates == (4 if alone is not runs[1] else 2)
