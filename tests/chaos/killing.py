"""A small run that is killed wherever the tests like, and what must be equal in the end."""

import json
import os
from collections.abc import Collection
from pathlib import Path

from headway.config import Config
from headway.experiment import training
from headway.experiment.methods import make_config
from headway.storage import files, progress_store
from headway.storage.run_dir import RunDir
from headway.training.progress import Progress

TINY = {
    "collection.episode_length": 6,
    "collection.num_iterations": 3,
    "fitting.epochs": 3,
    "model.hidden_sizes": (8, 8),
    "model.context_hidden_sizes": (8,),
    "planner.num_candidates": 8,
    "planner.horizon": 3,
}
ALWAYS, NEVER = 0.0, 1e9  # seconds between two writes of progress


def tiny_config(env: str = "pendulum", **settings) -> Config:
    return make_config(env, preset="smoke", settings={**TINY, **settings})


class Killed(BaseException):
    """Stands for SIGKILL: nothing in the package catches it."""


class Trigger:
    """Kills at the n-th place where a kill makes a difference; 0 only counts the places."""

    def __init__(self, at: int = 0):
        self.at = at
        self.places = 0

    def pull(self) -> None:
        self.places += 1
        if self.places == self.at:
            raise Killed


class KillingOS:
    """The module `os`, as `headway.storage.files` sees it, with a trigger around all writes."""

    def __init__(self, trigger: Trigger):
        self._trigger = trigger

    def __getattr__(self, name):
        return getattr(os, name)

    def fdopen(self, handle, mode):
        return (
            _KillingFile(os.fdopen(handle, mode), self._trigger)
            if mode == "wb"
            else os.fdopen(handle, mode)
        )

    def fsync(self, handle):
        self._trigger.pull()
        os.fsync(handle)

    def unlink(self, path):
        self._trigger.pull()
        os.unlink(path)  # noqa: PTH108

    def replace(self, source, target):
        self._trigger.pull()
        os.replace(source, target)  # noqa: PTH105
        self._trigger.pull()


class _KillingFile:
    """A file that may be cut off in the middle of a write."""

    def __init__(self, file, trigger: Trigger):
        self._file, self._trigger = file, trigger

    def __getattr__(self, name):
        return getattr(self._file, name)

    def __enter__(self):
        return self

    def __exit__(self, *error):
        self._file.close()

    def write(self, content):
        half = len(content) // 2
        self._file.write(content[:half])
        self._file.flush()
        self._trigger.pull()
        self._file.write(content[half:])


class KillingProgress(Progress):
    """Kills in the middle of the work as well."""

    def __init__(self, trigger: Trigger):
        self._trigger = trigger

    def phase(self, name, total):
        self._trigger.pull()

    def advance(self, amount=1, **values):
        self._trigger.pull()


def train(config: Config, path: Path, monkeypatch, *, kill_at: int = 0, every: float = NEVER):
    """Train in this process; returns the trigger, which says at how many places it was.

    Raises:
        Killed: At the place asked for.
    """
    trigger = Trigger(kill_at)
    with monkeypatch.context() as patch:
        patch.setattr(files, "os", KillingOS(trigger))
        patch.setattr(progress_store, "EVERY", every)
        training.train_run(config, path, KillingProgress(trigger))
    return trigger


class Listening(Progress):
    """Remembers what was said."""

    def __init__(self):
        self.said = []

    def message(self, text):
        self.said.append(text)


def result(path: Path, without: Collection[str] = ()) -> dict:
    """Everything that a run leaves behind, apart from times and what depends on them."""
    RunDir(path).check()
    metrics = [json.loads(line) for line in (path / "metrics.jsonl").read_text().splitlines()]
    contents = {
        str(file.relative_to(path)): file.read_bytes()
        for file in sorted(path.rglob("*"))
        if file.is_file()
        and file.name not in ("metrics.jsonl", ".lock", *without)
        and not {"manifests", "tensorboard"} & set(file.parts)
    }
    names = [
        str(file.relative_to(path)) for file in sorted(path.rglob("*")) if file.name != ".lock"
    ]
    untimed = [{k: v for k, v in row.items() if k != "seconds"} for row in metrics]
    return {"contents": contents, "names": names, "metrics": untimed}
