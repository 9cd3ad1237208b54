"""Finding the process of a run, and checking that nothing of it was lost or made twice."""

from pathlib import Path

import pytest

from headway.training.run import LOCK, RunDir
from headway.training.train import train_run


def holder(path: Path) -> int:
    """The process that holds a run directory.

    Raises:
        LookupError: There is none.
    """
    inode = (path / LOCK).stat().st_ino
    for line in Path("/proc/locks").read_text().splitlines():
        fields = line.split()
        if fields[1] == "FLOCK" and fields[5].endswith(f":{inode}"):
            return int(fields[4])
    raise LookupError(f"nobody holds {path}")


def first_written(path: Path) -> int:
    """When the data of the first iteration were written."""
    return (path / "data/iteration-000.safetensors").stat().st_mtime_ns


def returns(path: Path) -> list[float]:
    """The return of every test episode of a run."""
    return [row.episode_return for row in RunDir(path).evaluation()]


def check_whole(job, calm: Path) -> None:
    """A run is finished, with each iteration once, and as if it had been made in peace."""
    assert job.finished
    RunDir(job.path).check()
    iterations = [line["iteration"] for line in RunDir(job.path).metrics()]
    assert iterations == list(range(job.num_iterations))
    train_run(job.config, calm)
    # Worker and test may compute with different numbers of threads.
    assert returns(job.path) == pytest.approx(returns(calm), rel=1e-4)
