"""The finished iterations of a run: a manifest for each, and the files that it stands on."""

import contextlib
import re
from collections.abc import Iterator
from pathlib import Path

from headway.errors import HeadwayError, RunError
from headway.storage import files
from headway.storage.manifest import Digest, Manifest, inside
from headway.storage.tables import TABLES

KEPT = 2  # checkpoints, so that there is one to go back to


class Iterations:
    """Which iterations of a run count, by the manifests that stand there.

    Args:
        root: The run directory.
    """

    def __init__(self, root: Path):
        self._root = root

    @property
    def numbers(self) -> list[int]:
        """The iterations that have a manifest, in their order."""
        return list(map(number, self.files("manifests")))

    def files(self, folder: str) -> list[Path]:
        """The files of a folder that belong to an iteration, by its number."""
        found = inside(self._root, folder).glob("iteration-*")
        return sorted((path for path in found if number(path) >= 0), key=number)

    def newest(self) -> Manifest | None:
        """What the newest finished iteration stands on; None before the first.

        Raises:
            RunError: It is damaged; the message says how to go back.
        """
        numbers = self.numbers
        if not numbers:
            return None
        with self.advice():
            return self._read(numbers[-1])

    def last_good(self) -> int | None:
        """The newest finished iteration whose files are all as they were written."""
        for iteration in reversed(self.numbers):
            with contextlib.suppress(HeadwayError):
                self._read(iteration).check(self._root)
                return iteration
        return None

    def go_back(self) -> int | None:
        """Forget the iterations after the last good one.

        Returns:
            The last good iteration; None when none was finished yet.

        Raises:
            RunError: No finished iteration is intact.
        """
        numbers = self.numbers
        good = self.last_good()
        if good is None and numbers:
            raise RunError(
                f"{self._root} has no intact iteration to go back to; restore it from a copy, or"
                " start anew in another directory."
            )
        newer = [one for one in reversed(numbers) if good is not None and one > good]
        files.remove(inside(self._root, manifest_name(one)) for one in newer)
        return good

    def finish(self, iteration: int) -> None:
        """Make an iteration count, once all its files are written."""
        previous = self.newest()
        known = {} if previous is None else previous.files
        old = {name: digest for name, digest in known.items() if name.startswith("data/")}
        new = self._digests(iteration, range(iteration, iteration + 1))
        self._write(iteration, {**old, **new})

    def finish_all(self, count: int, config: bytes) -> None:
        """Make the first iterations of a run count that was trained before there were manifests.

        Args:
            count: How many are finished.
            config: What `config.json` will hold.
        """
        digests = self._digests(count - 1, range(count))
        self._write(count - 1, {**digests, "config.json": Digest.of_bytes(config)})

    def drop_old(self) -> None:
        """Delete manifests, checkpoints and tests that nobody goes back to."""
        numbers = self.numbers
        if numbers:
            kept = range(numbers[-1] - KEPT + 1, numbers[-1] + 2)
            for folder in ("manifests", "checkpoints", "tests"):
                found = self.files(folder)
                files.remove(path for path in found if number(path) not in kept)

    @contextlib.contextmanager
    def advice(self) -> Iterator[None]:
        """Add to an error how to go back."""
        try:
            yield
        except RunError as error:
            good = self.last_good()
            advice = (
                "No earlier iteration is intact; restore the file, or start anew in another"
                " directory."
                if good is None
                else f"The last good iteration is {good}: the run's `headway train` command with"
                " --resume-from-last-good goes back to it."
            )
            raise RunError(f"{error} {advice}") from None

    def _read(self, iteration: int) -> Manifest:
        path = inside(self._root, manifest_name(iteration))
        manifest = Manifest.read(path)
        if manifest.iteration != iteration:
            raise files.damaged(path, f"it is of iteration {manifest.iteration}")
        return manifest

    def _write(self, iteration: int, digests: dict[str, Digest]) -> None:
        Manifest(iteration, digests).write(inside(self._root, manifest_name(iteration)))

    def _digests(self, iteration: int, data: range) -> dict[str, Digest]:
        """The files of an iteration as they are now, with the data of some iterations."""
        found = [path for path in self.files("data") if number(path) in data]
        found += [path for path in self.files("tests") if number(path) == iteration]
        names = ["config.json", *TABLES, checkpoint_name(iteration)]
        names += [path.relative_to(self._root).as_posix() for path in found]
        return {name: Digest.of(inside(self._root, name)) for name in names}


def checkpoint_name(iteration: int) -> str:
    """The file, inside the run directory, with what was learned after an iteration."""
    return f"checkpoints/iteration-{iteration:03d}.safetensors"


def tests_name(iteration: int) -> str:
    """The two files, inside the run directory and without suffix, with an iteration's tests."""
    return f"tests/iteration-{iteration:03d}"


def manifest_name(iteration: int) -> str:
    """The file, inside the run directory, that makes an iteration count."""
    return f"manifests/iteration-{iteration:03d}.json"


def number(path: Path) -> int:
    """The iteration that a file belongs to; -1 for a file that is not ours."""
    found = re.fullmatch(r"iteration-(\d{3,9})\.\w+", path.name)
    return int(found[1]) if found else -1
