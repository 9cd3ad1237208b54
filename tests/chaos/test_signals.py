"""Ctrl-C and SIGTERM save what is done, and say so with the exit code."""

import itertools
import os
import signal
import subprocess
import sys
import time

import jax
import killing
import numpy as np
import pytest
from killing import ALWAYS, NEVER

from headway.errors import BadEnvironmentError
from headway.experiment import resumable, training
from headway.experiment.learners import multi_headed
from headway.experiment.rollouts import Choice
from headway.planning.acting import RandomAgent
from headway.storage import progress_store
from headway.storage.interrupts import StopRequest, Terminated
from headway.storage.progress_store import ProgressStore
from headway.training.progress import Progress


class Signalling(Progress):
    """Sends a signal to this process at the n-th step or epoch."""

    def __init__(self, number: int, at: int):
        self._number, self._at = number, at
        self.steps = 0

    def advance(self, amount=1, **values):
        self.steps += 1
        if self.steps == self._at:
            signal.raise_signal(self._number)


@pytest.mark.parametrize("at", [1, 9, 14, 27, 69])
@pytest.mark.parametrize(
    ("number", "error", "code"),
    [(signal.SIGINT, KeyboardInterrupt, None), (signal.SIGTERM, Terminated, 143)],
)
def test_a_signal_saves_and_stops_anywhere(number, error, code, at, reference, tmp_path):
    handlers = [signal.getsignal(n) for n in (signal.SIGINT, signal.SIGTERM)]
    path = tmp_path / "run"
    stopped = Signalling(number, at)
    with pytest.raises(error) as caught:
        training.train_run(killing.tiny_config(), path, stopped)
    assert getattr(caught.value, "code", None) == code
    assert stopped.steps == at
    assert [signal.getsignal(n) for n in (signal.SIGINT, signal.SIGTERM)] == handlers
    again = Signalling(number, -1)
    training.train_run(killing.tiny_config(), path, again)
    assert killing.result(path) == killing.result(reference)


def test_nothing_that_was_done_is_done_again(reference, tmp_path, monkeypatch):
    """The planner is asked exactly as often as in a run that was never stopped."""
    plans = []
    act = training.AgentPolicy.__call__

    def counted(self, obs):
        plans.append(1)
        return act(self, obs)

    monkeypatch.setattr(training.AgentPolicy, "__call__", counted)
    training.train_run(killing.tiny_config(), tmp_path / "whole")
    whole = len(plans)
    plans.clear()
    for at in (20, 8, 8, 8, 8, 8, 8):
        try:
            training.train_run(killing.tiny_config(), tmp_path / "cut", Signalling(15, at))
        except Terminated:
            continue
    training.train_run(killing.tiny_config(), tmp_path / "cut")
    assert len(plans) == whole
    assert killing.result(tmp_path / "cut") == killing.result(reference)


def test_a_fit_goes_on_at_the_epoch_where_it_stopped(tmp_path, monkeypatch):
    config = killing.tiny_config()
    fits = []
    fit = multi_headed.fit_epoch

    def counted(*asked, **named):
        fits.append(1)
        return fit(*asked, **named)

    monkeypatch.setattr(multi_headed, "fit_epoch", counted)
    training.train_run(config, tmp_path / "whole")
    whole = len(fits)
    fits.clear()
    stops = 0
    for at in (8, *[2] * 60):
        try:
            training.train_run(config, tmp_path / "cut", Signalling(15, at))
            break
        except Terminated:
            stops += 1
    training.train_run(config, tmp_path / "cut")
    assert stops > 3
    assert len(fits) == whole
    assert killing.result(tmp_path / "cut") == killing.result(tmp_path / "whole")


class InLastTest(Signalling):
    """Counts the steps of the last iteration's test only."""

    def phase(self, iteration, num_iterations, name, total):
        last = (iteration, name) == (num_iterations - 1, "evaluate")
        self.steps = 0 if last else -(10**6)


@pytest.mark.parametrize("at", [3, 10, 17])
def test_what_planning_took_is_counted_through_a_stop(at, tmp_path, monkeypatch):
    """Stops are in the middle of the first, second and third batch of the last test."""
    uses = []
    evaluate = training.evaluate_agent

    def noted(*asked, **named):
        found, use = evaluate(*asked, **named)
        uses.append(use)
        return found, use

    monkeypatch.setattr(training, "evaluate_agent", noted)
    training.train_run(killing.tiny_config(), tmp_path / "whole")
    wanted = uses[-1]
    with pytest.raises(Terminated):
        training.train_run(killing.tiny_config(), tmp_path / "cut", InLastTest(15, at))
    training.train_run(killing.tiny_config(), tmp_path / "cut")
    got = uses[-1]
    assert wanted.evaluations > wanted.steps > 0
    assert (got.steps, got.failures, got.evaluations) == (
        wanted.steps,
        wanted.failures,
        wanted.evaluations,
    )
    assert got.timed_steps < wanted.timed_steps  # repeated actions are not timed


@pytest.fixture
def heeded():
    """SIGINT as at a terminal: what a shell starts in the background ignores it."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, before)


@pytest.mark.usefixtures("heeded")
def test_a_second_signal_stops_at_once(tmp_path):
    class Impatient(Progress):
        def advance(self, amount=1, **values):
            signal.raise_signal(signal.SIGINT)
            signal.raise_signal(signal.SIGINT)
            pytest.fail("still at work")

    with pytest.raises(KeyboardInterrupt):
        training.train_run(killing.tiny_config(), tmp_path / "run", Impatient())


def test_progress_is_saved_twice_a_minute(tmp_path, monkeypatch):
    """With a clock that ticks 10 s per look, every third part is written."""
    ticks = iter(range(0, 10**6, 10))
    monkeypatch.setattr(progress_store.time, "monotonic", lambda: next(ticks))
    store = progress_store.ProgressStore(tmp_path / "partial", 0, "origin", training.StopRequest())
    written = []
    for number in range(9):
        part = progress_store.Part({"n": np.array([number])}, {})
        store.offer("part", lambda part=part: part)
        kept = progress_store.ProgressStore(store.folder, 0, "origin", training.StopRequest())
        kept.open()
        found = kept.load("part")
        written.append(None if found is None else int(found.arrays["n"][0]))
    lost = [n - (-1 if w is None else w) for n, w in enumerate(written)]
    assert max(lost) <= 3
    assert len(set(written)) >= 3


def test_parts_of_another_run_are_not_used(tmp_path):
    stop = training.StopRequest()
    store = progress_store.ProgressStore(tmp_path / "partial", 1, "one run", stop)
    store.offer("fit", lambda: progress_store.Part({"n": np.zeros(1)}, {}))
    store.save()
    for iteration, origin in ((1, "another run"), (2, "one run")):
        other = progress_store.ProgressStore(store.folder, iteration, origin, stop)
        other.open()
        assert other.load("fit") is None


def test_damaged_parts_are_reported_and_done_again(reference, tmp_path):
    path = tmp_path / "run"
    with pytest.raises(Terminated):
        training.train_run(killing.tiny_config(), path, Signalling(signal.SIGTERM, 14))
    part = next((path / "partial").glob("*.safetensors"))
    part.write_bytes(part.read_bytes()[:-1])
    said = []

    class Listening(Progress):
        def message(self, text):
            said.append(text)

    training.train_run(killing.tiny_config(), path, Listening())
    assert part.name in said[0]
    assert "begins anew" in said[0]
    assert killing.result(path) == killing.result(reference)


def test_parts_that_another_version_kept_are_done_again(reference, tmp_path, monkeypatch):
    path = tmp_path / "run"
    with pytest.raises(Terminated):  # in the middle of the second test
        training.train_run(killing.tiny_config(), path, Signalling(signal.SIGTERM, 34))
    load, read = progress_store.ProgressStore.load, []

    def other_names(self, name):
        part = load(self, name)
        if part is not None:
            read.append(name)
            return part._replace(arrays={f"old.{n}": part.arrays[n] for n in part.arrays})
        return None

    monkeypatch.setattr(progress_store.ProgressStore, "load", other_names)
    training.train_run(killing.tiny_config(), path)
    assert read == ["collect", "fit", "evaluate-0-actions"]
    assert killing.result(path) == killing.result(reference)


def test_an_environment_that_does_not_repeat_itself_begins_the_episodes_anew(tmp_path, monkeypatch):
    path = tmp_path / "run"
    with pytest.raises(Terminated):  # in the middle of the second collection
        training.train_run(killing.tiny_config(), path, Signalling(signal.SIGTERM, 25))
    plain = training.Arena.make

    def other_physics(config):
        arena = plain(config)
        reset = arena.vector.reset
        arena.vector.reset = lambda **asked: (reset(**asked)[0] + np.float32(1e-3), {})
        return arena

    monkeypatch.setattr(training.Arena, "make", other_physics)
    given_up = []
    whole = resumable.run_episodes

    def run_episodes(*asked):
        try:
            return whole(*asked)
        except Exception as error:
            given_up.append(type(error))
            raise

    monkeypatch.setattr(resumable, "run_episodes", run_episodes)
    run = training.train_run(killing.tiny_config(), path)
    assert len(run.metrics()) == 3
    assert given_up == [resumable._NotRepeatableError]


def test_episodes_that_end_before_the_kept_actions_do_begin_anew(tmp_path):
    """Actions that were planned for other observations are not taken for these."""
    arena = training.Arena.make(killing.tiny_config())
    num_envs = arena.vector.num_envs
    none = np.zeros(num_envs, int)
    plans = []

    class Still(training.AgentPolicy):
        def __init__(self):
            self.state = RandomAgent(arena.task).init(num_envs, key=jax.random.key(0))

        def __call__(self, obs):
            plans.append(1)
            return Choice(np.zeros((num_envs, 1), np.float32), none, none)

    def attempt(stop):
        store = ProgressStore(tmp_path / "partial", 1, "origin", stop)
        store.open()
        episodes = [
            training.Episode({"mass": 1.0, "length": 1.0}, seed) for seed in range(num_envs)
        ]

        def on_step(_):
            stop.signal = signal.SIGTERM if len(plans) == 4 else None

        return resumable.resumable_episodes(store, "collect", arena, episodes, Still, on_step)

    with pytest.raises(Terminated):
        attempt(StopRequest())
    plans.clear()
    step = arena.vector.step
    ends = itertools.cycle([np.zeros(num_envs, bool), np.ones(num_envs, bool)])

    def other_step(actions):
        obs, reward, _, cut, info = step(actions)
        return obs, reward, next(ends), cut, info

    arena.vector.step = other_step
    found = attempt(StopRequest())
    assert [len(trajectory) for trajectory in found.trajectories] == [2] * num_envs
    assert len(plans) == 2


def test_an_error_is_not_hidden_by_a_request_to_stop(tmp_path):
    class Failing(Progress):
        def advance(self, amount=1, **values):
            signal.raise_signal(signal.SIGTERM)
            raise BadEnvironmentError("broken")

    with pytest.raises(BadEnvironmentError):
        training.train_run(killing.tiny_config(), tmp_path / "run", Failing())


SCRIPT = """
import sys
import killing
from headway.experiment import training
from headway.storage import progress_store
progress_store.EVERY = float(sys.argv[2])
training.train_run(killing.tiny_config(), sys.argv[1])
"""


@pytest.fixture(scope="module")
def environment(tmp_path_factory):
    """Compiled code is kept between the processes."""
    here = os.path.dirname(__file__)  # noqa: PTH120
    return {
        **os.environ,
        "PYTHONPATH": os.pathsep.join([here, os.environ.get("PYTHONPATH", "")]),
        "JAX_COMPILATION_CACHE_DIR": str(tmp_path_factory.mktemp("compiled")),
        "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": "0",
        "JAX_PERSISTENT_CACHE_MIN_ENTRY_SIZE_BYTES": "-1",
    }


@pytest.mark.slow
def test_true_sigkills_change_nothing(environment, tmp_path):
    def start(path, every):
        words = [sys.executable, "-c", SCRIPT, str(path), str(every)]
        return subprocess.Popen(words, env=environment)

    assert start(tmp_path / "whole", NEVER).wait() == 0
    rng = np.random.default_rng(0)
    kills = runs = 0
    while kills < 10:
        path = tmp_path / f"run-{runs}"
        for _ in range(4):
            before = set(path.rglob("*"))
            process = start(path, ALWAYS)
            while process.poll() is None and set(path.rglob("*")) <= before:
                time.sleep(0.01)  # until it has done something
            try:
                process.wait(rng.uniform(0.0, 3.0))
                break
            except subprocess.TimeoutExpired:
                process.kill()
                process.wait()
                kills += 1
                finished = len(list((path / "manifests").glob("iteration-*.json")))
                parts = len(list((path / "partial").glob("*.safetensors")))
                print(f"kill {kills}: {finished} manifests, {parts} parts")
        assert start(path, NEVER).wait() == 0
        assert killing.result(path) == killing.result(tmp_path / "whole"), (kills, runs)
        runs += 1


@pytest.mark.slow
@pytest.mark.parametrize(("number", "code"), [(signal.SIGINT, 130), (signal.SIGTERM, 143)])
def test_the_command_saves_and_exits_with_the_code_of_the_signal(
    number, code, environment, tmp_path
):
    path = tmp_path / "run"
    words = [sys.executable, "-m", "headway", "train", "pendulum", "--preset", "smoke", "--quiet"]
    words += ["--collection.num-iterations", "500", "--run-dir", str(path)]
    process = subprocess.Popen(words, env=environment, stderr=subprocess.PIPE, text=True)
    while process.poll() is None and not (path / "manifests").exists():
        time.sleep(0.1)
    process.send_signal(number)
    _, errors = process.communicate()
    assert process.returncode == code
    assert "the same command goes on where this one stopped" in errors.splitlines()[-1]
    assert "Traceback" not in errors
    training.RunDir(path).check()
