"""A disk that forgets: what a loss of power may leave of a directory.

A file's content is safe once the file was synced, its name once its directory was synced.
Everything later may or may not have reached the disk, each thing for itself.
"""

import os
import stat
from pathlib import Path

import numpy as np
from killing import KillingOS, Trigger


class ForgetfulOS(KillingOS):
    """The module `os` that remembers what was synced below a folder."""

    def __init__(self, trigger: Trigger, root: Path):
        super().__init__(trigger)
        self._root = root
        self._contents: dict[int, bytes] = {}
        self._names: dict[Path, dict[str, int]] = {}

    def fsync(self, handle):
        super().fsync(handle)
        path = Path(f"/proc/self/fd/{handle}").readlink()
        facts = os.fstat(handle)
        if stat.S_ISDIR(facts.st_mode):
            self._names[path] = {entry.name: entry.lstat().st_ino for entry in path.iterdir()}
        else:
            self._contents[facts.st_ino] = path.read_bytes()

    def after_power_loss(self, target: Path, rng: np.random.Generator) -> None:
        """Write to `target` what may be left of the root."""
        kept = {file.lstat().st_ino: file for file in self._root.rglob("*")}
        self._rebuild(self._root, target, kept, rng)

    def _rebuild(self, source, target, kept, rng) -> None:
        target.mkdir()
        synced = self._names.get(source, {})
        now = {entry.name: entry.lstat().st_ino for entry in source.iterdir()}
        for name in sorted({*synced, *now}):
            inode = (synced, now)[rng.integers(2)].get(name)
            if inode is None:
                continue
            if (source / name).is_dir():
                self._rebuild(source / name, target / name, kept, rng)
            else:
                (target / name).write_bytes(self._content(inode, kept, rng))

    def _content(self, inode: int, kept: dict[int, Path], rng) -> bytes:
        """Synced content is safe; of other content any part may be there, or nothing."""
        if inode in self._contents:
            return self._contents[inode]
        if inode not in kept:
            return b""
        content = kept[inode].read_bytes()
        return content[: rng.integers(len(content) + 1)]
