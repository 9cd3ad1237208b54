"""Displays of a run: silent, plain lines, a bar."""

import sys

from headway.training import progress
from headway.training.progress import Bar, Lines, Progress, make_progress

METRICS = {
    "iteration": 0,
    "timesteps": 1000,
    "collection": {"return_mean": -1200.0, "return_std": 90.0},
    "evaluation": {"unseen": {"return_mean": -800.0, "return_std": 10.0}},
}
RETURNS = "iteration 1 done: collected -1200 ± 90; unseen -800 ± 10"


def drive(display):
    """One iteration of two, then a part of the second."""
    with display:
        display.phase("[1/2] collect", 10)
        display.advance(10)
        display.phase("[1/2] fit", 4)
        for _ in range(4):
            display.advance(1, loss=0.5)
        display.iteration_done(METRICS)
        display.message("careful [bold]")
        display.phase("[2/2] collect", 10)
        display.advance(5)


def test_plain_lines_go_to_stderr_only(capsys):
    drive(Progress())  # silent
    assert capsys.readouterr() == ("", "")
    drive(Lines())
    out, err = capsys.readouterr()
    assert out == ""
    lines = err.splitlines()
    assert [line.partition(" took")[0] for line in lines] == [
        "[1/2] collect", "[1/2] fit", RETURNS, "careful [bold]", "[2/2] collect"
    ]  # fmt: skip
    assert lines[0].endswith(" per second)")


def test_a_long_phase_gives_signs_of_life(capsys, monkeypatch):
    monkeypatch.setattr(progress, "SILENCE", 0.0)
    display = Lines()
    display.phase("fit", 4)
    display.advance(1, loss=2.0)
    display.__exit__(KeyboardInterrupt, KeyboardInterrupt(), None)  # cut short, it has no end
    assert capsys.readouterr().err == "fit 25% loss 2\n"


def test_the_bar_shows_where_the_run_is(capsys, monkeypatch):
    monkeypatch.setenv("FORCE_COLOR", "1")
    monkeypatch.setenv("TERM", "xterm")
    monkeypatch.setenv("COLUMNS", "120")
    drive(Bar())
    out, err = capsys.readouterr()
    assert out == ""
    assert all(text in err for text in ("[2/2] collect", "5/10", RETURNS, "careful [bold]"))


def test_the_display_fits_the_stream(monkeypatch):
    assert type(make_progress(quiet=True)) is Progress
    assert isinstance(make_progress(), Lines)
    monkeypatch.setattr(sys.stderr, "isatty", lambda: True)
    assert isinstance(make_progress(), Bar)
