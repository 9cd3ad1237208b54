"""The commit of the checkout that Headway is imported from, read without Git."""

import re
from pathlib import Path

ROOT = Path(__file__).parents[3]
"""Of the checkout, if it is one; an installed package has no `.git` there."""


def commit(root: Path = ROOT) -> str | None:
    """The commit that is checked out; None where there is no checkout, or it cannot be read.

    Changes that are not committed are not told.

    Args:
        root: The directory that holds `src/headway` and `.git`.
    """
    if not (root / "src" / "headway").is_dir():
        return None
    try:
        folder = _git_folder(root / ".git")
        head = (folder / "HEAD").read_text().strip()
        name = head.removeprefix("ref: ")
        found = head if name == head else _resolve(folder, name)
    except (OSError, ValueError):
        return None
    return found if re.fullmatch(r"[0-9a-f]{40}([0-9a-f]{24})?", found) else None


def _git_folder(path: Path) -> Path:
    """Where Git keeps the checkout; a further worktree has a file that names it."""
    if path.is_dir():
        return path
    return path.parent / path.read_text().strip().removeprefix("gitdir: ")


def _resolve(folder: Path, name: str) -> str:
    """The commit of a branch; further worktrees share those of the first."""
    common = folder / "commondir"
    shared = folder / common.read_text().strip() if common.exists() else folder
    if (shared / name).exists():
        return (shared / name).read_text().strip()
    lines = (shared / "packed-refs").read_text().splitlines()
    return next((line.split()[0] for line in lines if line.endswith(f" {name}")), "")
