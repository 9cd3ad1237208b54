"""Nodes and drivers that die in the middle of a sweep; minutes, so not in the default suite."""

import json
import signal
import subprocess
import sys
import time

import fakes
import pytest
from ray_checks import check_whole, first_written, holder

ray = pytest.importorskip("ray", reason="Ray is not installed")

from ray.cluster_utils import Cluster  # noqa: E402

from headway.sweeps.running import Workers, run_jobs  # noqa: E402

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(sys.platform != "linux", reason="finds processes in /proc"),
]
LONGER = {"collection.num_iterations": 5}


@pytest.fixture
def cluster(monkeypatch):
    """A cluster whose first node, with the driver, takes no runs; three more have a core each."""
    monkeypatch.setenv("RAY_USAGE_STATS_ENABLED", "0")
    made = Cluster(initialize_head=True, head_node_args={"num_cpus": 0})
    nodes = [made.add_node(num_cpus=1) for _ in range(3)]
    ray.init(made.address, log_to_driver=False)
    made.wait_for_nodes()
    yield made, nodes
    ray.shutdown()
    made.shutdown()


class RemovingNode(fakes.Remembering):
    """Kills a node once every node has a run that has finished an iteration."""

    def __init__(self, cluster, nodes):
        super().__init__()
        self._cluster, self._nodes = cluster, nodes
        self.written = {}

    def show(self, job, before, status):
        super().show(job, before, status)
        begun = [
            path
            for path, one in self.statuses.items()
            if one.state == "running" and one.iteration > 0
        ]
        if not self.written and len(begun) == len(self._nodes):
            self.written = {path: first_written(path) for path in begun}
            self._cluster.remove_node(self._nodes[1], allow_graceful=False)


def test_a_node_that_is_killed_loses_nothing(cluster, tmp_path):
    jobs = [fakes.tiny_job(tmp_path, seed, **LONGER) for seed in range(5)]
    board = RemovingNode(*cluster)
    run_jobs(jobs, Workers(), board)
    assert {status.state for status in board.statuses.values()} == {"done"}
    assert len(board.written) == 3
    lost = [path for path, status in board.told if status.state == "lost"]
    assert len(lost) == 1
    assert lost[0] in board.written
    for path, written in board.written.items():
        assert first_written(path) == written
    for job in jobs:
        check_whole(job, tmp_path / job.path.name)


def sweep_command(out):
    settings = {**fakes.TINY, **LONGER}
    return [
        sys.executable, "-m", "headway", "sweep", "--envs", "pendulum", "--preset", "smoke",
        "--seeds", "0:2", "--out", str(out), "--json",
        "--settings", *(f"{name}={json.dumps(value)}" for name, value in settings.items()),
    ]  # fmt: skip


def wait_for(condition, seconds=300.0):
    end = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < end, "it never came"
        time.sleep(0.1)


def is_held(path):
    try:
        return bool(holder(path))
    except (LookupError, FileNotFoundError):
        return False


@pytest.mark.parametrize(
    ("signal_number", "code"),
    [(signal.SIGKILL, -signal.SIGKILL), (signal.SIGINT, 130), (signal.SIGTERM, 143)],
)
def test_a_driver_that_is_stopped_goes_on_when_it_is_begun_again(tmp_path, signal_number, code):
    jobs = [fakes.tiny_job(tmp_path, seed, **LONGER) for seed in (0, 1)]
    first = tmp_path / "first.log"
    with first.open("w") as log:
        driver = subprocess.Popen(sweep_command(tmp_path), stdout=log, stderr=log)
        wait_for(lambda: any(job.finished_iterations for job in jobs) or driver.poll() is not None)
        assert driver.poll() is None, first.read_text()
        driver.send_signal(signal_number)
        driver.wait(60)
    assert driver.returncode == code, first.read_text()
    written = {job.path: first_written(job.path) for job in jobs if job.finished_iterations}
    assert written
    assert not all(job.finished for job in jobs)
    # Not waiting for the old workers: their locks keep the new ones out until they are gone.
    done = subprocess.run(sweep_command(tmp_path), capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert len(json.loads(done.stdout)["returns"]) == 2
    for path, when in written.items():
        assert first_written(path) == when
    assert not any(is_held(job.path) for job in jobs)
    for job in jobs:
        check_whole(job, tmp_path / "calm" / job.path.name)
