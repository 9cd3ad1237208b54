"""A run that is killed or stopped anywhere ends like one that never was; a full disk loses nothing.

A kill is an exception that nothing in the package catches, raised around writes and between steps.
"""

import contextlib
import errno
import functools
import os
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

import runs
from headway.errors import BadEnvironmentError, LimitError, RunError
from headway.training import train
from headway.training.methods import make_config
from headway.training.progress import Progress
from headway.training.run import RunDir
from headway.training.stopping import Terminated

ALWAYS, NEVER = 0.0, 1e9  # seconds between two writes of a fit


class Killed(BaseException):
    """Stands for SIGKILL."""


class Places(Progress):
    """Counts the places where a kill makes a difference, and kills at one of them.

    Args:
        at: Which one; 0 only counts.
        from_here: Fail at every write from there on, instead of being killed there.
    """

    def __init__(self, at=0, from_here: OSError | None = None):
        self.at, self.from_here, self.count = at, from_here, 0

    def pull(self, *, writing=True):
        self.count += 1
        if self.from_here is None and self.count == self.at:
            raise Killed
        if self.from_here is not None and writing and self.count >= self.at:
            raise self.from_here

    def phase(self, name, total):
        self.pull(writing=False)

    def advance(self, amount=1, **values):
        self.pull(writing=False)


def pulled(plain, places, *args, **named):
    places.pull()
    done = plain(*args, **named)
    places.pull()
    return done


def train_until(places, path, monkeypatch, every=NEVER, config=None):
    """Train with a kill, or a full disk, wherever `places` says; returns the number of places."""
    with monkeypatch.context() as patch:
        for name in ("fsync", "replace", "unlink"):
            patch.setattr(os, name, functools.partial(pulled, getattr(os, name), places))
        patch.setattr(train, "SAVE_EVERY", every)
        train.train_run(config or runs.tiny_config(), path, places)
    return places.count


MANY = [pytest.param(seed, marks=pytest.mark.slow) for seed in range(1, 30)]


@pytest.mark.parametrize("seed", [0, *MANY])
def test_kills_change_nothing(seed, reference, tmp_path, monkeypatch):
    rng = np.random.default_rng(seed)
    count = train_until(Places(), tmp_path / "whole", monkeypatch, ALWAYS)
    assert count > 200
    assert runs.result(tmp_path / "whole") == runs.result(reference)
    kills = 0
    for number in range(3):
        path = tmp_path / f"run-{number}"
        for every in rng.choice([ALWAYS, NEVER], 4):
            with contextlib.suppress(Killed):
                train_until(Places(rng.integers(1, count)), path, monkeypatch, every)
                break
            kills += 1
        train.train_run(runs.tiny_config(), path)
        assert runs.result(path) == runs.result(reference)
    assert kills > 1  # a place beyond the end of a run kills nobody


def test_a_finished_run_goes_on_to_more_iterations_wherever_it_is_killed(tmp_path, monkeypatch):
    short, longer = (runs.random_config(**{"collection.num_iterations": n}) for n in (1, 2))
    train.train_run(short, tmp_path / "short")
    train.train_run(longer, shutil.copytree(tmp_path / "short", tmp_path / "whole"))
    for place in range(3, 15, 3):  # before, between and after its two files are replaced
        path = shutil.copytree(tmp_path / "short", tmp_path / f"run-{place}")
        with pytest.raises(Killed):
            train_until(Places(place), path, monkeypatch, config=longer)
        run = train.train_run(longer, path)
        assert run.config().collection == longer.collection
        assert runs.result(path) == runs.result(tmp_path / "whole")
    with pytest.raises(RunError, match=r"collection\.num_iterations: 2 -> 1"):
        train.train_run(short, path)


@pytest.mark.parametrize("place", [1, 2, 40, 150])
def test_a_disk_that_runs_full_stops_the_run_and_loses_nothing(
    place, reference, tmp_path, monkeypatch
):
    full = Places(place, OSError(errno.ENOSPC, "No space left on device"))
    with pytest.raises(LimitError, match=r"too full to write .*the same command goes on"):
        train_until(full, tmp_path / "run", monkeypatch, ALWAYS)
    train.train_run(runs.tiny_config(), tmp_path / "run")
    assert runs.result(tmp_path / "run") == runs.result(reference)


def test_a_loss_of_power_finds_no_iteration_that_counts_without_its_files(tmp_path, monkeypatch):
    """Content is synced before its name, and all names before the name of the checksums."""
    synced, unsynced_names = set(), set()
    fsync, replace = os.fsync, os.replace
    counted = []

    def syncing(handle):
        fsync(handle)
        synced.add(os.fstat(handle).st_ino)
        unsynced_names.discard(os.fstat(handle).st_ino)

    def renaming(source, target):
        assert Path(source).stat().st_ino in synced, source
        if Path(target).parent.name == "checksums":
            assert not unsynced_names
            counted.append(target)
        replace(source, target)
        unsynced_names.add(Path(target).parent.stat().st_ino)

    with monkeypatch.context() as patch:
        patch.setattr(os, "fsync", syncing)
        patch.setattr(os, "replace", renaming)
        train.train_run(runs.tiny_config(), tmp_path / "run")
    assert len(counted) == 3


class Signalling(Progress):
    """Sends a signal to this process at the n-th step or epoch, and does something then."""

    def __init__(self, number: int, at: int, then=lambda: None):
        self.number, self.at, self.then, self.steps = number, at, then, 0

    def advance(self, amount=1, **values):
        self.steps += 1
        if self.steps == self.at:
            signal.raise_signal(self.number)
            self.then()


@pytest.fixture(autouse=True)
def heeded():
    """SIGINT as at a terminal: what a shell starts in the background ignores it."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, before)


@pytest.mark.parametrize(
    ("number", "at", "kept"),
    [
        (signal.SIGTERM, 1, set()),
        (signal.SIGINT, 14, {"collect", "fit"}),  # the second epoch of the first fit
        (signal.SIGTERM, 30, {"collect", "fit", "evaluate-0"}),
        (signal.SIGINT, 45, set()),
    ],
)
def test_a_signal_stops_with_all_that_is_finished(number, at, kept, reference, tmp_path):
    path = tmp_path / "run"
    handlers = [signal.getsignal(n) for n in (signal.SIGINT, signal.SIGTERM)]
    stopped = Signalling(number, at)
    with pytest.raises((KeyboardInterrupt, Terminated)) as caught:
        train.train_run(runs.tiny_config(), path, stopped)
    code = None if number == signal.SIGINT else 143
    assert (getattr(caught.value, "code", None), stopped.steps) == (code, at)
    assert [signal.getsignal(n) for n in (signal.SIGINT, signal.SIGTERM)] == handlers
    assert {file.stem for file in path.glob("partial/*.safetensors")} == kept
    train.train_run(runs.tiny_config(), path)
    assert runs.result(path) == runs.result(reference)


@pytest.mark.parametrize(
    "method",
    [
        "grbal",
        "true-dynamics",
        *(pytest.param(m, marks=pytest.mark.slow) for m in ("rebal", "ria")),
    ],
)
def test_a_run_of_any_kind_goes_on_where_it_stopped(method, tmp_path):
    config = make_config("pendulum", method=method, preset="smoke")
    train.train_run(config, tmp_path / "whole")
    for at in (22, 23, 45, 30):
        with contextlib.suppress(Terminated):
            train.train_run(config, tmp_path / "cut", Signalling(signal.SIGTERM, at))
    train.train_run(config, tmp_path / "cut")
    assert runs.result(tmp_path / "cut") == runs.result(tmp_path / "whole")


def test_damaged_parts_are_done_again(reference, tmp_path):
    path = tmp_path / "run"
    with pytest.raises(Terminated):
        train.train_run(runs.tiny_config(), path, Signalling(signal.SIGTERM, 30))
    parts = list(path.glob("partial/*"))
    assert len(parts) == 3
    for part in parts:
        content = bytearray(part.read_bytes())
        content[-3] ^= 1
        part.write_bytes(content)
    train.train_run(runs.tiny_config(), path)
    assert runs.result(path) == runs.result(reference)


def test_parts_of_another_run_are_not_used(root):
    RunDir(root).partial().save("fit", {"n": np.zeros(1)}, {"epochs": 1})
    assert RunDir(root).partial().load("fit") is not None
    (root / "checksums/iteration-001.json").unlink()
    assert RunDir(root).partial().load("fit") is None


def again():
    signal.raise_signal(signal.SIGINT)
    pytest.fail("still at work")


def broken():
    raise BadEnvironmentError("broken")


@pytest.mark.parametrize(
    ("then", "error"), [(again, KeyboardInterrupt), (broken, BadEnvironmentError)]
)
def test_a_second_signal_stops_at_once_and_an_error_is_not_hidden(then, error, tmp_path):
    with pytest.raises(error):
        train.train_run(runs.tiny_config(), tmp_path / "run", Signalling(signal.SIGINT, 1, then))


@pytest.mark.slow
def test_true_sigkills_change_nothing(tmp_path):
    words = [sys.executable, "-m", "headway", "train", "pendulum", "--preset", "smoke", "--quiet"]
    words += ["--collection.num-iterations", "4", "--run-dir"]
    subprocess.run([*words, tmp_path / "whole"], check=True)
    rng = np.random.default_rng(0)
    kills = 0
    while kills < 10:
        path = tmp_path / f"run-{kills}"
        for _ in range(4):
            before = set(path.rglob("*"))
            process = subprocess.Popen([*words, path])
            while process.poll() is None and set(path.rglob("*")) <= before:
                time.sleep(0.01)  # until it has done something
            try:
                process.wait(rng.uniform(0.0, 3.0))
                break
            except subprocess.TimeoutExpired:
                process.kill()
                process.wait()
                kills += 1
        subprocess.run([*words, path], check=True)
        assert runs.result(path) == runs.result(tmp_path / "whole"), kills
