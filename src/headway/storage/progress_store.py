"""Finished parts of the unfinished iteration, so that a killed run loses at most a minute.

Parts (episodes, a fit after some epochs) are handed over as often as they grow, and written when
half a minute has passed since the last time. Each is a file of its own, under a new name every
time; the store's manifest points to the newest.
"""

import contextlib
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

from headway.storage import arrays, files
from headway.storage.arrays import Arrays
from headway.storage.interrupts import StopRequest
from headway.storage.manifest import Digest, Manifest

EVERY = 30.0  # seconds between two writes


class Part(NamedTuple):
    """What is kept of a part of an iteration."""

    arrays: Arrays
    facts: dict[str, Any]
    """JSON values."""


class ProgressStore:
    """Keeps the parts of one iteration.

    Args:
        folder: Where; the folder belongs to the store alone.
        iteration: The unfinished iteration.
        origin: What the iteration goes on from; parts with another origin are not used.
        stop: Asks to save and stop.
    """

    def __init__(self, folder: Path, iteration: int, origin: str, stop: StopRequest):
        self.folder = folder
        self.seconds: dict[str, float] = {}
        self._iteration, self._origin, self._stop = iteration, origin, stop
        self._pending: dict[str, Callable[[], Part]] = {}
        self._parts: dict[str, tuple[str, dict[str, Any]]] = {}  # file and facts
        self._digests: dict[str, Digest] = {}
        self._serial = 0
        self._written = time.monotonic()
        self._count: Callable[[], None] = lambda: None

    def open(self) -> None:
        """Find what an interrupted attempt at the same iteration kept.

        Raises:
            RunError: A file is damaged; nothing is used then.
        """
        path = self.folder / "manifest.json"
        if not path.exists():
            return
        manifest, facts = Manifest.read_with_facts(path)
        if (manifest.iteration, facts.get("origin")) != (self._iteration, self._origin):
            self.clear()  # left by an iteration that was finished, or by another run
            return
        manifest.check(self.folder)
        try:
            parts = {n: (part["file"], dict(part["facts"])) for n, part in facts["parts"].items()}
            seconds = {name: float(value) for name, value in facts["seconds"].items()}
            serial = int(facts["serial"])
            fitting = {file for file, _ in parts.values()} == set(manifest.files)
        except (KeyError, TypeError, AttributeError, ValueError) as error:
            raise files.damaged(path, f"it lacks {error}") from None
        if not fitting:
            raise files.damaged(path, "its parts are not its files")
        self._parts, self._digests = parts, manifest.files
        self.seconds, self._serial = seconds, serial

    def path(self, name: str) -> Path:
        """The file of a part that was kept."""
        return self.folder / self._parts[name][0]

    def load(self, name: str) -> Part | None:
        """What an interrupted attempt kept of a part; None when there is nothing.

        Raises:
            RunError: The file holds no arrays.
        """
        if name not in self._parts:
            return None
        return Part(arrays.load_arrays(self.path(name)), self._parts[name][1])

    def offer(self, name: str, make: Callable[[], Part]) -> None:
        """Hand over a part as it is now; written when it is time, or before a requested stop.

        Raises:
            KeyboardInterrupt: A stop was requested; everything is saved.
            Terminated: Likewise.
        """
        self._pending[name] = make
        if time.monotonic() - self._written >= EVERY:
            self.save()
        self.stop_if_asked()

    def stop_if_asked(self) -> None:
        """Save and stop, if a signal asked for it.

        Raises:
            KeyboardInterrupt: Ctrl-C was pressed; everything is saved.
            Terminated: SIGTERM was sent; everything is saved.
        """
        if self._stop:
            self.save()
            self._stop.answer()

    def drop(self, name: str) -> None:
        """Forget a part."""
        self._pending.pop(name, None)
        self._parts.pop(name, None)

    @contextlib.contextmanager
    def timing(self, name: str) -> Iterator[None]:
        """Count the seconds of a phase, those of interrupted attempts included."""
        before, start = self.seconds.get(name, 0.0), time.perf_counter()

        def count() -> None:
            self.seconds[name] = round(before + time.perf_counter() - start, 3)

        self._count = count
        yield
        count()

    def save(self) -> None:
        """Write what was handed over."""
        self._count()
        for name, make in self._pending.items():
            part = make()
            self._serial += 1
            file = f"{name}-{self._serial}.safetensors"
            arrays.save_arrays(self.folder / file, part.arrays)
            self._parts[name] = file, part.facts
            self._digests[file] = Digest.of(self.folder / file)
        self._pending.clear()
        used = {file for file, _ in self._parts.values()}
        self._digests = {file: self._digests[file] for file in used}
        Manifest(self._iteration, self._digests).write(
            self.folder / "manifest.json",
            origin=self._origin,
            serial=self._serial,
            seconds=self.seconds,
            parts={
                name: {"file": file, "facts": facts} for name, (file, facts) in self._parts.items()
            },
        )
        files.remove(p for p in self.folder.glob("*.safetensors") if p.name not in used)
        self._written = time.monotonic()

    def clear(self) -> None:
        """Delete everything, once the iteration is finished or cannot be taken up."""
        self._pending.clear()
        self._parts.clear()
        if self.folder.is_dir():
            files.remove([self.folder / "manifest.json", *self.folder.glob("*.safetensors")])
            with contextlib.suppress(OSError):  # somebody else's file stays, and so the folder
                self.folder.rmdir()
