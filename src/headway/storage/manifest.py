"""What a run's files were when an iteration was finished: sizes and checksums."""

import dataclasses
import hashlib
from collections.abc import Iterable
from pathlib import Path, PurePosixPath
from typing import Any, NamedTuple

from headway.errors import RunError
from headway.storage import files
from headway.storage.config_file import SCHEMA

CHANGED = "its bytes are not the ones that were written"


class Digest(NamedTuple):
    """Size and checksum of the first bytes of a file; tables grow behind them."""

    num_bytes: int
    sha256: str

    @classmethod
    def of_bytes(cls, content: bytes) -> "Digest":
        """Of what is, or will be, all of a file."""
        return cls(len(content), hashlib.sha256(content).hexdigest())

    @classmethod
    def of(cls, path: Path, num_bytes: int | None = None) -> "Digest":
        """Read a file piece by piece.

        Raises:
            RunError: The file is missing or no regular file.
        """
        found = hashlib.sha256()
        with files.open_file(path) as file:
            size = file.seek(0, 2) if num_bytes is None else num_bytes
            file.seek(0)
            for piece in files.chunks(file, size):
                found.update(piece)
        return cls(size, found.hexdigest())


@dataclasses.dataclass(frozen=True)
class Manifest:
    """The files that a finished iteration, or its unfinished successor, stands on."""

    iteration: int
    files: dict[str, Digest]
    """By path inside the run directory, with `/` on every system."""

    def write(self, path: Path, **facts: Any) -> None:
        """Write it, once everything that it names is written."""
        listed = {
            name: {"bytes": digest.num_bytes, "sha256": digest.sha256}
            for name, digest in sorted(self.files.items())
        }
        values = {"schema": SCHEMA, "iteration": self.iteration, **facts, "files": listed}
        files.write_bytes(path, files.seal(values))

    @classmethod
    def read(cls, path: Path) -> "Manifest":
        """Read it.

        Raises:
            RunError: It is missing, damaged, or names files outside of the run directory.
        """
        return cls.read_with_facts(path)[0]

    @classmethod
    def read_with_facts(cls, path: Path) -> tuple["Manifest", dict[str, Any]]:
        """Read it, and all that stands in its file.

        Raises:
            RunError: As `read`.
        """
        values = files.read_sealed(path)
        iteration, listed = values.get("iteration"), values.get("files")
        if values.get("schema") != SCHEMA or type(iteration) is not int or iteration < 0:
            raise files.damaged(path, f"it is no manifest of schema {SCHEMA}")
        if not isinstance(listed, dict):
            raise files.damaged(path, "it lists no files")
        return cls(iteration, {name: _digest(path, name, listed[name]) for name in listed}), values

    def check(self, root: Path, names: Iterable[str] | None = None) -> None:
        """Compare files with what they were.

        Args:
            root: The run directory.
            names: Which files; all of them by default.

        Raises:
            RunError: A file is missing or has changed; the message names it.
        """
        for name in self.files if names is None else names:
            wanted = self._wanted(root, name)
            if Digest.of(inside(root, name), wanted.num_bytes) != wanted:
                raise files.damaged(root / name, CHANGED)

    def read_text(self, root: Path, name: str) -> bytes:
        """Read the part of a table that counts.

        Raises:
            RunError: The file is missing or has changed.
        """
        wanted = self._wanted(root, name)
        content = files.read_bytes(inside(root, name))[: wanted.num_bytes]
        if Digest.of_bytes(content) != wanted:
            raise files.damaged(root / name, CHANGED)
        return content

    def _wanted(self, root: Path, name: str) -> Digest:
        if name not in self.files:
            raise RunError(f"{root / name} is not listed in the run's manifest; restore both.")
        return self.files[name]


def inside(root: Path, name: str) -> Path:
    """The path of a file of a run, which is never outside of it.

    Raises:
        RunError: The name, or a link in the run directory, leads elsewhere.
    """
    path = root / name
    if is_plain(name) and path.resolve().is_relative_to(root.resolve()):
        return path
    raise RunError(
        f"{path} leads outside of the run directory, allowed: files inside of it; move them there."
    )


def is_plain(name: str) -> bool:
    """Whether a path is relative, and goes down only."""
    parts = PurePosixPath(name).parts
    odd = "\\" in name or ":" in name or "\0" in name
    return bool(parts) and not odd and ".." not in parts and not name.startswith("/")


def _digest(path: Path, name: str, entry: Any) -> Digest:
    if not is_plain(name):
        raise files.damaged(path, f"it names {name[:80]!r}, which is outside of the run")
    try:
        digest = Digest(entry["bytes"], entry["sha256"])
    except (KeyError, TypeError):
        raise files.damaged(path, f"it says nothing of {name[:80]!r}") from None
    if type(digest.num_bytes) is not int or digest.num_bytes < 0:
        raise files.damaged(path, f"{name[:80]!r} has no size")
    return digest
