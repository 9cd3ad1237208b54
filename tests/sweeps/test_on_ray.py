"""Runs on Ray: workers, nodes and drivers die, and nothing is lost or made twice."""

import contextlib
import os
import signal
import sys

import fakes
import pytest
from ray_checks import check_whole, first_written, holder

ray = pytest.importorskip("ray", reason="Ray is not installed")

from headway.errors import ConfigError  # noqa: E402
from headway.sweeps import on_ray  # noqa: E402
from headway.sweeps.running import Workers, run_jobs  # noqa: E402

LINUX = pytest.mark.skipif(sys.platform != "linux", reason="finds processes in /proc")


@pytest.fixture
def shared_ray():
    """Ray on this machine, for two runs at a time."""
    os.environ["RAY_USAGE_STATS_ENABLED"] = "0"
    ray.init("local", num_cpus=2, include_dashboard=False, log_to_driver=False)
    yield
    ray.shutdown()


class Killing(fakes.Remembering):
    """Kills one worker, as soon as its run has finished an iteration but not the last one."""

    killed = None
    written = 0

    def show(self, job, before, status):
        super().show(job, before, status)
        if self.killed is None and status.state == "running" and status.iteration:
            with contextlib.suppress(LookupError):  # it has ended in the meantime
                os.kill(holder(job.path), signal.SIGKILL)
                self.killed, self.written = job, first_written(job.path)


@LINUX
def test_a_worker_that_is_killed_loses_nothing(shared_ray, tmp_path, monkeypatch):
    monkeypatch.setattr(on_ray, "PATIENCE", 0.1)
    more = {"collection.num_iterations": 6}
    jobs = [fakes.tiny_job(tmp_path, seed, **more) for seed in (0, 1)]
    board = Killing()
    run_jobs(jobs, Workers(), board)
    assert [board.statuses[job.path].state for job in jobs] == ["done", "done"]
    assert board.states(board.killed).count("lost") == 1
    assert board.states(next(job for job in jobs if job != board.killed)).count("lost") == 0
    # What was finished before is not made again.
    assert first_written(board.killed.path) == board.written
    for job in jobs:
        check_whole(job, tmp_path / job.path.name)


def test_what_no_node_can_hold_is_refused(shared_ray, tmp_path):
    jobs = [fakes.tiny_job(tmp_path)]
    with pytest.raises(ConfigError, match=r"reserves 64 cores .* at most 2 cores"):
        run_jobs(jobs, Workers(cpus_per_run=64), fakes.Remembering())
