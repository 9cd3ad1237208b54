"""How the driver of a sweep answers what becomes of its tasks; Ray itself is replaced."""

import itertools

import fakes
import pytest

pytest.importorskip("ray", reason="Ray is not installed")

from ray.exceptions import NodeDiedError, RayTaskError, WorkerCrashedError

from headway.errors import ConfigError
from headway.sweeps import on_ray
from headway.sweeps.running import Workers
from headway.sweeps.status import Status

DONE = {"state": "done", "iteration": 2}
BUSY = {"state": "busy", "note": "held by another process"}


class FakeRay:
    """Tasks end as soon as they are waited for, with what was prepared for their run's seed."""

    def __init__(self, ends):
        self.ends = ends  # lists of results and errors, by seed
        self.submitted = []
        self.cancelled = []

    def remote(self, config, path, mailbox):
        """Submit a task."""
        self.submitted.append(int(path[-1]))
        return (len(self.submitted), int(path[-1]))

    def get(self, asked):
        if asked == "reports":
            return {}
        end = self.ends[asked[1]].pop(0)
        if isinstance(end, BaseException):
            raise end
        return end

    def wait(self, tasks, **named):
        return list(tasks), []

    def cancel(self, task):
        self.cancelled.append(task[1])

    def kill(self, actor):
        pass


class FakeMailbox:
    class take:  # noqa: N801 (a method of an actor)
        @staticmethod
        def remote():
            return "reports"


@pytest.fixture
def ray_of(monkeypatch):
    """Replaces Ray by one whose tasks end as prepared."""

    def replace(*ends):
        fake = FakeRay(list(ends))
        monkeypatch.setattr(on_ray, "ray", fake)
        monkeypatch.setattr(on_ray, "PATIENCE", 0.0)
        monkeypatch.setattr(on_ray, "POLL", 0.0)
        return fake

    return replace


@pytest.fixture
def dispatch(ray_of, tmp_path):
    """Runs jobs of seeds 0, 1, ... on a Ray whose tasks end as prepared."""

    def run(*ends):
        fake = ray_of(*ends)
        jobs = [fakes.tiny_job(tmp_path, seed) for seed in range(len(ends))]
        board = fakes.Remembering()
        board.begin(jobs)
        with on_ray._Dispatcher(jobs, board, fake, FakeMailbox) as dispatcher:
            dispatcher.run()
        return fake, jobs, board

    return run


def test_a_lost_task_is_submitted_again_and_only_that(dispatch):
    fake, jobs, board = dispatch([WorkerCrashedError(), DONE], [DONE])
    assert fake.submitted == [0, 1, 0]
    assert board.states(jobs[0]) == ["lost", "done"]
    assert board.states(jobs[1]) == ["done"]


def test_a_busy_run_is_tried_until_it_is_free(dispatch):
    fake, jobs, board = dispatch([BUSY, BUSY, BUSY, BUSY, BUSY, BUSY, DONE])
    assert fake.submitted == [0] * 7
    assert board.statuses[jobs[0].path].state == "done"


def test_a_run_that_loses_all_its_workers_fails_and_says_so(dispatch):
    lost = [WorkerCrashedError() for _ in range(on_ray.MAX_LOSSES)]
    fake, jobs, board = dispatch([*lost, DONE], [DONE])
    assert fake.submitted.count(0) == on_ray.MAX_LOSSES
    assert board.statuses[jobs[1].path].state == "done"
    note = board.failures[jobs[0].path]
    assert "its worker died 5 times without finishing an iteration (WorkerCrashedError)" in note


def test_losses_are_forgiven_where_iterations_were_finished_between(dispatch, monkeypatch):
    looked = itertools.count(1)
    monkeypatch.setattr(on_ray, "first_status", lambda job: Status("waiting", next(looked)))
    lost = [NodeDiedError("gone") for _ in range(3 * on_ray.MAX_LOSSES)]
    fake, _, board = dispatch([*lost, DONE])
    assert len(fake.submitted) == 3 * on_ray.MAX_LOSSES + 1
    assert not board.failures


def test_an_error_of_the_program_is_not_tried_again(dispatch):
    error = RayTaskError("_work", "a traceback", ValueError("a bug"))
    fake, jobs, board = dispatch([error, DONE])
    assert fake.submitted == [0]
    assert board.failures[jobs[0].path] == "ValueError: a bug"


def test_what_still_runs_is_told_to_save_when_the_driver_stops(ray_of, tmp_path):
    fake = ray_of([DONE], [KeyboardInterrupt()], [DONE])
    jobs = [fakes.tiny_job(tmp_path, seed) for seed in range(3)]
    board = fakes.Remembering()
    board.begin(jobs)
    with (
        pytest.raises(KeyboardInterrupt),
        on_ray._Dispatcher(jobs, board, fake, FakeMailbox) as dispatcher,
    ):
        dispatcher.run()
    # The interrupt comes while the second of the three is settled.
    assert fake.cancelled == [2]


def connecting(fake, error=None):
    """Lets a fake Ray be started or joined; returns what it was told."""
    told = []

    def init(address, **options):
        told.append((address, options))
        if error is not None:
            raise error

    fake.is_initialized = lambda: False
    fake.init = init
    fake.shutdown = lambda: told.append("shutdown")
    return told


@pytest.mark.parametrize(
    ("error", "says"),
    [
        (
            ConnectionError("nobody\nanswers"),
            r"no Ray cluster at address '1.2.3.4:5' .*nobody answers",
        ),
        (RuntimeError("Version mismatch:\n  Ray: 2.1"), r"Version mismatch: Ray: 2.1\); a cluster"),
    ],
)
def test_a_cluster_that_cannot_be_joined_is_told_in_one_line(ray_of, error, says):
    connecting(ray_of(), error)
    with pytest.raises(ConfigError, match=says) as raised, on_ray._connected("1.2.3.4:5"):
        pass
    assert "\n" not in str(raised.value)


def test_the_ray_of_another_sweep_is_left_alone(ray_of):
    fake = ray_of()
    told = connecting(fake)
    fake.nodes = list
    with on_ray._connected(None):
        (_, options), *_ = told
    node = {"Alive": True, "Resources": {"CPU": 2.0, **options["resources"]}}
    fake.nodes = lambda: [node]
    with pytest.raises(ConfigError, match="belongs to another sweep"), on_ray._connected("auto"):
        pass
    assert told[1:] == ["shutdown", ("auto", told[2][1]), "shutdown"]
    assert "resources" not in told[2][1]
    fake.nodes = lambda: [{"Alive": True, "Resources": {"CPU": 2.0}}]
    with on_ray._connected("auto"):
        pass


def nodes(*resources, alive=True):
    return [
        {"Alive": alive, "Resources": dict(zip(("CPU", "GPU"), r, strict=True))} for r in resources
    ]


@pytest.mark.parametrize(
    ("workers", "gpus", "variables"),
    [
        (Workers(), 1.0, {"NPROC": "1"}),
        (Workers(cpus_per_run=2.5), 1.0, {"NPROC": "3"}),
        (Workers(gpus_per_run=0), 0.0, {"NPROC": "1", "JAX_PLATFORMS": "cpu"}),
        (
            Workers(gpus_per_run=0.5),
            0.5,
            {"NPROC": "1", "XLA_PYTHON_CLIENT_MEM_FRACTION": "0.450"},
        ),
    ],
)
def test_a_run_computes_with_what_it_reserves(ray_of, workers, gpus, variables):
    ray_of().nodes = lambda: nodes((8, 0), (4, 2))
    options = on_ray._task_options(workers)
    assert (options["num_cpus"], options["num_gpus"]) == (workers.cpus_per_run, gpus)
    assert options["runtime_env"]["env_vars"] == variables
    assert options["max_retries"] == 0


def test_a_node_must_hold_a_whole_run(ray_of):
    fake = ray_of()
    fake.nodes = lambda: [*nodes((8, 0), (2, 1)), *nodes((64, 8), alive=False)]
    with pytest.raises(ConfigError, match=r"reserves 4 cores and 1 GPUs, .* at most 8 cores"):
        on_ray._task_options(Workers(cpus_per_run=4, gpus_per_run=1))
