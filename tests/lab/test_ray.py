"""Workers, nodes and drivers die in the middle of a sweep, and nothing is lost or made twice."""

import contextlib
import json
import os
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path

import fakes
import pytest

ray = pytest.importorskip("ray", reason="Ray is not installed")

from ray.cluster_utils import Cluster  # noqa: E402

from headway.errors import ConfigError  # noqa: E402
from headway.lab.sweep import Workers, run_jobs  # noqa: E402
from headway.training.run import LOCK, RunDir  # noqa: E402
from headway.training.train import train_run  # noqa: E402

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="finds processes in /proc")
# Long enough to be stopped in the middle.
SETTINGS = {"collection.num_iterations": 30, "collection.episode_length": 6}
HERE = Workers(one_by_one=True)


@pytest.fixture(scope="module")
def two_cores():
    """Ray on this machine, for two runs at a time."""
    with pytest.MonkeyPatch.context() as patched:
        patched.setenv("RAY_USAGE_STATS_ENABLED", "0")
        ray.init("local", num_cpus=2, include_dashboard=False, log_to_driver=False)
        yield
        ray.shutdown()


def make_jobs(out, count):
    return [fakes.random_job(out, seed, **SETTINGS) for seed in range(count)]


def holder(path):
    """The process that holds a run directory, or None."""
    with contextlib.suppress(FileNotFoundError):
        inode = (path / LOCK).stat().st_ino
        for line in Path("/proc/locks").read_text().splitlines():
            fields = line.split()
            if fields[1] == "FLOCK" and fields[5].endswith(f":{inode}"):
                return int(fields[4])
    return None


def wait_for(condition, seconds=300.0):
    end = time.monotonic() + seconds
    while not (found := condition()):
        assert time.monotonic() < end, "it never came"
        time.sleep(0.05)
    return found


def begun(job):
    """Whether an iteration is finished, but not the last one."""
    return job.state.name == "begun" and job.state.iterations > 0


def check_whole(job, calm, before=()):
    """A run is finished as if it had been made in peace, and what was there is not made again."""
    run = RunDir(job.path)
    run.check()
    assert [line["iteration"] for line in run.metrics()] == list(range(30))
    assert run.metrics()[: len(before)] == list(before)  # with the seconds that it took
    train_run(job.config, calm)
    assert run.evaluation() == RunDir(calm).evaluation()


@pytest.mark.parametrize(
    "workers",
    [pytest.param(HERE, marks=pytest.mark.slow), Workers()],
    ids=["processes", "ray"],
)
@pytest.mark.usefixtures("two_cores")
def test_a_worker_that_is_killed_loses_nothing(workers, tmp_path, capsys):
    jobs, written = make_jobs(tmp_path, 2), []

    def kill():
        pid = wait_for(lambda: begun(jobs[0]) and holder(jobs[0].path))
        written.extend(RunDir(jobs[0].path).metrics())
        os.kill(pid, signal.SIGKILL)

    thread = threading.Thread(target=kill, daemon=True)
    thread.start()
    assert run_jobs(jobs, workers, quiet=False) == {}
    thread.join()
    assert capsys.readouterr().err.count("lost") == 1
    assert jobs[1].state.name == "done"
    check_whole(jobs[0], tmp_path / "calm", written)


@pytest.mark.usefixtures("two_cores")
def test_what_no_node_can_hold_is_refused(tmp_path):
    with pytest.raises(ConfigError, match=r"reserves 64 cores .* one node has \(2 and 0\)"):
        run_jobs(make_jobs(tmp_path, 1), Workers(cpus_per_run=64))


def test_a_cluster_that_cannot_be_joined_is_told_in_one_line(tmp_path, monkeypatch):
    def nobody(address, **options):
        raise ConnectionError(f"nobody\nanswers at {address}")

    monkeypatch.setattr(ray, "is_initialized", lambda: False)
    monkeypatch.setattr(ray, "init", nobody)
    with pytest.raises(ConfigError, match=r"Ray at 1.2.3.4:5 .* nobody answers") as raised:
        run_jobs(make_jobs(tmp_path, 1), Workers(address="1.2.3.4:5"))
    assert "\n" not in str(raised.value)


@pytest.mark.slow
def test_a_node_that_is_killed_loses_nothing(tmp_path, monkeypatch, capsys):
    """The first node, with the driver, takes no runs; three more have a core each."""
    monkeypatch.setenv("RAY_USAGE_STATS_ENABLED", "0")
    ray.shutdown()  # the machine of the tests above
    cluster = Cluster(initialize_head=True, head_node_args={"num_cpus": 0})
    nodes = [cluster.add_node(num_cpus=1) for _ in range(3)]
    ray.init(cluster.address, log_to_driver=False)
    jobs, written = make_jobs(tmp_path, 5), {}

    def remove():
        wait_for(lambda: any(map(begun, jobs)))
        written.update({job.path: RunDir(job.path).metrics() for job in jobs if begun(job)})
        cluster.remove_node(nodes[1], allow_graceful=False)

    thread = threading.Thread(target=remove, daemon=True)
    try:
        cluster.wait_for_nodes()
        thread.start()
        assert run_jobs(jobs, Workers(), quiet=False) == {}
    finally:
        thread.join()
        ray.shutdown()
        cluster.shutdown()
    assert capsys.readouterr().err.count("lost") == 1
    for job in jobs:
        check_whole(job, tmp_path / job.path.name, written.get(job.path, ()))


@pytest.mark.slow
@pytest.mark.parametrize("more", [[], ["--one-by-one"]], ids=["ray", "processes"])
@pytest.mark.parametrize(
    ("number", "code"), [(signal.SIGKILL, -9), (signal.SIGINT, 130), (signal.SIGTERM, 143)]
)
def test_a_driver_that_is_stopped_goes_on_when_it_is_begun_again(tmp_path, more, number, code):
    jobs, log = make_jobs(tmp_path, 2), tmp_path / "first.log"
    command = [
        sys.executable, "-m", "headway", "sweep", "--envs", "pendulum", "--preset", "smoke",
        "--methods", "random", "--seeds", "0:2", "--out", str(tmp_path), "--json", *more,
        "--settings", *(f"{name}={value}" for name, value in SETTINGS.items()),
    ]  # fmt: skip
    with log.open("w") as file:
        driver = subprocess.Popen(command, stdout=file, stderr=file)
        wait_for(lambda: any(map(begun, jobs)) or driver.poll() is not None)
        assert driver.poll() is None, log.read_text()
        driver.send_signal(number)
        driver.wait(60)
    assert driver.returncode == code, log.read_text()
    written = {job.path: RunDir(job.path).metrics() for job in jobs if job.state.iterations}
    assert written
    # Not waiting for the old workers: their locks keep the new ones out until they are gone.
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert len(json.loads(done.stdout)["returns"]) == 2
    for job in jobs:
        assert holder(job.path) is None
        check_whole(job, tmp_path / "calm" / job.path.name, written.get(job.path, ()))
