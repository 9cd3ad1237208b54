"""Missing runs are made once each, whatever happens to some of them."""

import io
import itertools
import shutil

import fakes
import pytest
from rich.console import Console

from headway.errors import ConfigError, RunError
from headway.sweeps import running
from headway.sweeps.board import PlainBoard, describe
from headway.sweeps.jobs import Job
from headway.sweeps.live_board import LiveBoard
from headway.sweeps.running import Workers, run_jobs
from headway.sweeps.status import Status, StatusProgress
from headway.training.run import LOCK, RunDir

HERE = Workers(one_by_one=True)


@pytest.fixture
def training(monkeypatch):
    """Replaces training by writing; runs that are held are tried again at once."""
    fake = fakes.FakeTraining()
    monkeypatch.setattr(running, "train_run", fake)
    monkeypatch.setattr(running, "PATIENCE", 0.0)
    return fake


def test_runs_are_made_in_order_and_only_once(training, tmp_path, monkeypatch):
    jobs = [fakes.tiny_job(tmp_path, seed) for seed in (2, 0, 1)]
    board = fakes.Remembering()
    run_jobs(jobs, HERE, board)
    assert [seed for _, seed in training.calls] == [2, 0, 1]
    assert all(status.state == "done" for status in board.statuses.values())
    assert board.states(jobs[0]) == ["running", "running", "done"]
    again = fakes.Remembering()
    run_jobs([*jobs, fakes.tiny_job(tmp_path, 3)], HERE, again)
    assert [seed for _, seed in training.calls] == [2, 0, 1, 3]
    monkeypatch.setattr(running, "make_run", None)  # nothing is begun for what is finished
    run_jobs(jobs, HERE, fakes.Remembering())


def test_a_run_that_fails_does_not_stop_the_others(training, tmp_path):
    training.answers = {0: [fakes.DIVERGED]}
    jobs = [fakes.tiny_job(tmp_path, seed) for seed in (0, 1)]
    board = fakes.Remembering()
    run_jobs(jobs, HERE, board)
    assert board.failures == {jobs[0].path: "no finite number"}
    assert jobs[1].finished


def test_a_damaged_directory_is_told_and_left_alone(training, tmp_path):
    jobs = [fakes.tiny_job(tmp_path, seed) for seed in (0, 1)]
    jobs[0].path.mkdir(parents=True)
    (jobs[0].path / "config.json").write_text("{")
    board = fakes.Remembering()
    run_jobs(jobs, HERE, board)
    assert "config.json is damaged" in board.failures[jobs[0].path]
    assert [seed for _, seed in training.calls] == [1]


def test_a_run_with_a_damaged_table_does_not_count_as_finished(two_iterations, tmp_path):
    job = Job.of(RunDir(two_iterations).config(), tmp_path)
    shutil.copytree(two_iterations, job.path)
    assert job.finished_iterations == 2
    (job.path / "metrics.jsonl").write_text("{}\n")
    with pytest.raises(RunError, match=r"metrics.jsonl is damaged"):
        _ = job.finished_iterations


def test_a_run_that_another_process_holds_is_waited_for(training, tmp_path):
    training.answers = {0: [fakes.BUSY, fakes.BUSY]}
    jobs = [fakes.tiny_job(tmp_path, seed) for seed in (0, 1)]
    board = fakes.Remembering()
    run_jobs(jobs, HERE, board)
    assert [seed for _, seed in training.calls] == [0, 1, 0, 0]
    assert [state for state in board.states(jobs[0]) if state != "running"] == [
        "busy",
        "busy",
        "done",
    ]


def test_what_the_other_process_finished_is_not_made_again(training, tmp_path, monkeypatch):
    job = fakes.tiny_job(tmp_path)
    training.answers = {0: [fakes.BUSY]}
    monkeypatch.setattr(running.time, "sleep", lambda _: fakes.write_run(job.config, job.path))
    run_jobs([job], HERE, fakes.Remembering())
    assert len(training.calls) == 1


def test_a_held_directory_is_busy_and_that_is_said_once(tmp_path, monkeypatch):
    job = fakes.tiny_job(tmp_path)
    job.path.mkdir(parents=True)
    stream, tries = io.StringIO(), itertools.count(1)

    def sleep(_):
        if next(tries) == 3:
            fakes.write_run(job.config, job.path)

    monkeypatch.setattr(running.time, "sleep", sleep)
    with RunDir(job.path).locked():
        run_jobs([job], HERE, PlainBoard(stream))
    _, busy, done = stream.getvalue().splitlines()
    assert "busy  0/2" in busy
    assert "another process" in busy
    assert "done  2/2" in done


def test_an_error_that_is_not_headways_does_not_stop_the_others(training, tmp_path, monkeypatch):
    def held(config, path, progress):
        with RunDir(path).locked():
            training(config, path, progress)

    monkeypatch.setattr(running, "train_run", held)
    jobs = [fakes.tiny_job(tmp_path, seed) for seed in (0, 1)]
    fakes.write_run(jobs[0].config, jobs[0].path)
    (jobs[0].path / "metrics.jsonl").unlink()
    (jobs[0].path / LOCK).mkdir(parents=True)
    board = fakes.Remembering()
    run_jobs(jobs, HERE, board)
    assert board.failures.keys() == {jobs[0].path}
    assert "IsADirectoryError" in board.failures[jobs[0].path]
    assert jobs[1].finished


def test_without_ray_it_says_what_to_install(training, tmp_path, monkeypatch):
    monkeypatch.setattr(running, "ray_is_installed", lambda: False)
    jobs = [fakes.tiny_job(tmp_path, seed) for seed in (0, 1)]
    board = fakes.Remembering()
    run_jobs(jobs, Workers(), board)
    assert len(training.calls) == 2
    assert "`pip install '.[ray]'` in the clone" in board.messages[0]
    with pytest.raises(ConfigError, match=r"pip install '\.\[ray\]'"):
        run_jobs([fakes.tiny_job(tmp_path, 2)], Workers(address="auto"), board)


@pytest.mark.parametrize(
    "wrong",
    [
        {"cpus_per_run": 0},
        {"gpus_per_run": -1},
        {"one_by_one": True, "address": "auto"},
        {"one_by_one": True, "cpus_per_run": 2},
        {"gpus_per_run": 1.5},
    ],
)
def test_impossible_workers_are_refused(wrong):
    with pytest.raises(ConfigError, match=r"allowed|leave one out"):
        Workers(**wrong)


def test_status_follows_a_run_and_reports_seldom():
    now = [0.0]
    told = []
    progress = StatusProgress(told.append, 1, clock=lambda: now[0])
    assert told == []
    with progress:
        assert told == [Status("running", 1, "preparing")]
    progress.phase("collect", 10)
    for _ in range(10):
        now[0] += 0.2
        progress.advance(1)
    assert [status.phase for status in told[2:]] == ["collect 30%", "collect 60%", "collect 90%"]
    metrics = {"iteration": 1, "collection": {"return_mean": -5.0, "return_std": 1.0}}
    progress.iteration_done(metrics)
    assert (told[-1].iteration, told[-1].returns) == (2, "collected -5")
    progress.message("the fit goes back")
    progress.message("the episode is dropped")
    assert told[-1].messages == ("the fit goes back", "the episode is dropped")
    assert told[-1].iteration == 2


def test_what_a_run_says_is_shown_once_and_named(training, tmp_path, monkeypatch):
    def talking(config, path, progress):
        with progress:
            progress.message("an episode is dropped")
            progress.message("a fit begins anew")
        training(config, path, progress)

    monkeypatch.setattr(running, "train_run", talking)
    job = fakes.tiny_job(tmp_path)
    board = fakes.Remembering()
    run_jobs([job], HERE, board)
    assert board.messages == [
        f"{describe(job)}: {text}" for text in ("an episode is dropped", "a fit begins anew")
    ]


def test_a_message_that_was_lost_on_its_way_comes_with_the_next_report(tmp_path):
    board = fakes.Remembering()
    job = fakes.tiny_job(tmp_path)
    board.begin([job])
    board.tell(job, Status("running", 0, messages=("one",)))
    board.tell(job, Status("done", 2, messages=("one", "two", "three")))
    assert [text.rpartition(" ")[2] for text in board.messages] == ["one", "two", "three"]


def test_reports_after_the_end_change_nothing(tmp_path):
    board = fakes.Remembering()
    job = fakes.tiny_job(tmp_path)
    board.begin([job])
    board.tell(job, Status("done", 2))
    board.tell(job, Status("running", 1))
    assert board.statuses[job.path] == Status("done", 2)


def test_lines_say_what_begins_and_ends(tmp_path):
    stream = io.StringIO()
    job = fakes.tiny_job(tmp_path)
    with PlainBoard(stream) as board:
        board.begin([job])
        board.tell(job, Status("running", 0, "fit 10%"))
        board.tell(job, Status("running", 0, "fit 20%"))
        board.tell(job, Status("running", 1, "fit 0%", "collected -5"))
        board.tell(job, Status("failed", 1, note="no finite number"))
    lines = stream.getvalue().splitlines()
    assert len(lines) == 4
    assert lines[0] == "1 runs, 0 of them done already"
    assert lines[2].endswith("running  1/2  collected -5")
    assert lines[3].startswith("[1/1] ")
    assert lines[3].endswith("failed  1/2  no finite number")


def test_the_live_table_shows_every_run_and_the_busiest_first(tmp_path):
    console = Console(
        file=io.StringIO(), width=160, height=9, force_terminal=True, color_system=None
    )
    jobs = [fakes.tiny_job(tmp_path, seed) for seed in range(6)]
    board = LiveBoard(console)
    board.begin(jobs)
    board.tell(jobs[4], Status("running", 1, "fit 40%", "collected -310 ± 55"))
    board.tell(jobs[0], Status("done", 2))
    with console.capture() as captured:
        console.print(board._render())
    lines = captured.get().splitlines()
    assert lines[1].split() == [
        *jobs[4].path.parts[-3:], "running", "1/2", "fit", "40%", "collected", "-310", "±", "55",
    ]  # fmt: skip
    assert lines[-1].strip() == "6 runs: 1 running, 4 waiting, 1 done; 2 not shown"
