import io

import pytest
from rich.console import Console

from headway.experiment.live_progress import RichProgress
from headway.experiment.progress import Estimate, PlainProgress, Progress, duration, make_progress

METRICS = {
    "iteration": 0,
    "timesteps": 1000,
    "collection": {"return_mean": -1200.0, "return_std": 90.0},
    "evaluation": {"unseen": {"return_mean": -800.0, "return_std": 10.0, "episodes": 2}},
}


class Clock:
    def __init__(self):
        self.now = 0.0

    def __call__(self):
        return self.now


def drive(progress, clock):
    """One iteration of two, then a part of the second."""
    with progress:
        progress.phase(0, 2, "collect", 10)
        clock.now += 1
        progress.advance(10)
        progress.phase(0, 2, "fit", 4)
        for _ in range(4):
            clock.now += 2
            progress.advance(1, loss=0.5)
        progress.iteration_done(METRICS)
        progress.message("careful")
        progress.phase(1, 2, "collect", 10)
        clock.now += 40
        progress.advance(5)


def test_the_silent_display_says_nothing(capsys):
    drive(Progress(), Clock())
    assert capsys.readouterr() == ("", "")


def test_plain_lines_go_to_stderr_only(capsys):
    clock = Clock()
    drive(PlainProgress(clock=clock), clock)
    out, err = capsys.readouterr()
    assert out == ""
    assert err.splitlines() == [
        "[1/2] collect took 1.0 s (10 steps/s)",
        "[1/2] fit took 8.0 s (0.5 epochs/s)",
        "iteration 1 done: collected -1200 ± 90; unseen -800 ± 10; 1000 steps in all",
        "careful",
        "[2/2] collect 50%; about 56 s left",
        "[2/2] collect took 40.0 s (0.125 steps/s)",
    ]


def test_plain_lines_are_rate_limited():
    clock, stream = Clock(), io.StringIO()
    progress = PlainProgress(stream, every=10.0, clock=clock)
    progress.phase(0, 1, "fit", 1000)
    for _ in range(1000):
        clock.now += 0.1
        progress.advance(1, loss=2.0)
    assert 8 <= len(stream.getvalue().splitlines()) <= 10
    assert "loss 2" in stream.getvalue()


def test_the_live_display_shows_where_the_run_is(capsys):
    clock = Clock()
    console = Console(file=io.StringIO(), width=120, force_terminal=True)
    progress = RichProgress(console, clock=clock)
    drive(progress, clock)
    with console.capture() as captured:
        console.print(progress._render())
    text = captured.get()
    for part in ("iteration 2/2", "collect", "5/10", "0.125 steps/s", "49 s so far", "56 s left"):
        assert part in text
    assert "unseen -800 ± 10" in console.file.getvalue()
    assert capsys.readouterr().out == ""


def test_the_time_left_uses_announced_phases():
    clock = Clock()
    estimate = Estimate(clock)
    estimate.schedule([(0, "collect", 10), (1, "collect", 10), (1, "evaluate", 20)])
    estimate.start(0, 2, "collect", 10)
    clock.now += 1
    estimate.advance(10)
    assert estimate.left is None, "random collection says nothing about planned collection"
    estimate.start(1, 2, "collect", 10)
    clock.now += 5
    estimate.advance(5)
    assert estimate.left == pytest.approx(5 + 20)


def test_a_fit_takes_longer_with_more_data():
    clock = Clock()
    estimate = Estimate(clock)
    estimate.schedule([(0, "fit", 4), (2, "fit", 4)])
    estimate.start(0, 3, "fit", 4)
    clock.now += 4
    estimate.advance(4)
    estimate.finish()
    assert estimate.left == pytest.approx(3 * 4)


def test_the_display_fits_the_stream(monkeypatch):
    assert type(make_progress(quiet=True)) is Progress
    assert isinstance(make_progress(), PlainProgress)
    monkeypatch.setattr("sys.stderr.isatty", lambda: True)
    assert isinstance(make_progress(), RichProgress)


@pytest.mark.parametrize(
    ("seconds", "text"),
    [
        (59, "59 s"),
        (200, "3 min 20 s"),
        (7500, "2 h 5 min"),
        (172_799.4, "47 h 59 min"),
        (1291 * 3600 + 25 * 60, "53 d 19 h"),
    ],
)
def test_durations(seconds, text):
    assert duration(seconds) == text
