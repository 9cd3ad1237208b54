"""`headway reproduce` and `headway sweep` on the command line."""

import json
import re

import fakes
import pytest

from headway.cli import main
from headway.lab.paper import EXPERIMENTS
from headway.training.run import RunDir

WORDS = ("--envs", "pendulum", "--preset", "smoke", "--one-by-one", "--quiet")


def run(capsys, *words):
    """Exit code, stdout and stderr of one command."""
    code = main(words)
    captured = capsys.readouterr()
    return code, captured.out, captured.err


def test_reproduce_on_the_command_line(training, tmp_path, capsys):
    words = ("reproduce", "fig13", *WORDS, "--seeds", "0:2", "--out", str(tmp_path))
    code, out, _ = run(capsys, *words)
    assert code == 0
    assert re.search(r"T-MCL +2 +41.5 ± 0.7 +– +141.5 ± 0.7", out)
    assert "headway reproduce fig13 --envs pendulum --preset smoke" in out
    code, out, _ = run(capsys, *words, "--json")
    facts = json.loads(out)
    assert (code, facts["runs"], facts["failures"], len(facts["files"])) == (0, 4, {}, 4)
    assert {(p["arm"], p["seed"], p["value"]) for p in facts["returns"]} == {
        ("MCL", 0, 31.0), ("MCL", 1, 32.0), ("T-MCL", 0, 41.0), ("T-MCL", 1, 42.0)
    }  # fmt: skip
    assert len(training.calls) == 4


@pytest.mark.usefixtures("training", "without_figures")
def test_sweeps_of_the_same_name_do_not_replace_each_other(tmp_path, capsys):
    words = ("sweep", *WORDS, "--seeds", "0", "--out", str(tmp_path), "--json")
    files = [
        json.loads(run(capsys, *words, "--methods", *methods)[1])["files"]
        for methods in (["pets"], ["pets", "tmcl"], ["mcl"])
    ]
    assert files[0] == files[1] != files[2]


def test_a_failed_run_is_told_on_stderr_with_exit_code_1(training, tmp_path, capsys):
    training.answers = {0: [fakes.DIVERGED]}
    words = ("reproduce", "fig13", *WORDS, "--seeds", "0", "--out", str(tmp_path))
    code, out, err = run(capsys, *words)
    assert code == 1
    assert "seed0: no finite number" in err
    assert "T-MCL" in out


def test_dry_run_lists_and_runs_nothing(training, tmp_path, capsys):
    words = ("reproduce", "fig15", *WORDS, "--seeds", "0", "--out", str(tmp_path), "--dry-run")
    code, out, _ = run(capsys, *words)
    assert code == 0
    assert "5 of 5 runs are missing" in out
    code, out, _ = run(capsys, *words, "--json")
    facts = json.loads(out)
    assert [entry["state"] for entry in facts["runs"]] == ["missing"] * 5
    assert facts["runs"][0]["arms"] == ["M = 1"]
    assert training.calls == []
    assert list(tmp_path.iterdir()) == []


def test_sweep_on_the_command_line(training, tmp_path, capsys):
    code, out, _ = run(
        capsys, "sweep", *WORDS, "--seeds", "5", "--out", str(tmp_path), "--name", "mine",
        "--methods", "pets", "tmcl", "--settings", "planner.horizon=3,5", "fitting.epochs=1",
        "--json",
    )  # fmt: skip
    assert code == 0
    assert [point["arm"] for point in json.loads(out)["returns"]] == [
        "PETS, planner.horizon 3", "PETS, planner.horizon 5",
        "T-MCL, planner.horizon 3", "T-MCL, planner.horizon 5",
    ]  # fmt: skip
    assert "smoke`, fitting.epochs 1, seeds 5" in (tmp_path / "mine-smoke/mine.md").read_text()
    runs = list(tmp_path.glob("runs/pendulum/*/seed5"))
    settings = [RunDir(path).config() for path in runs]
    assert sorted(config.planner.horizon for config in settings) == [3, 3, 5, 5]
    assert {config.fitting.epochs for config in settings} == {1}


def test_reproduce_takes_one_value_of_a_setting(tmp_path, capsys):
    words = ("reproduce", "fig13", *WORDS, "--settings", "planner.horizon=1,2")
    code, _, err = run(capsys, *words)
    assert code == 1
    assert "planner.horizon has 2 values, allowed: one" in err


def test_an_unknown_experiment_is_told_with_the_closest(capsys):
    code, _, err = run(capsys, "reproduce", "fgi13", *WORDS)
    assert code == 1
    assert "Did you mean 'fig13'?" in err


def test_a_real_run_through_the_command_line(tmp_path, capsys):
    settings = [f"{name}={json.dumps(value)}" for name, value in fakes.TINY.items()]
    words = ("reproduce", "fig10", *WORDS, "--seeds", "0", "--out", str(tmp_path))
    code, out, _ = run(capsys, *words, "--settings", *settings, "--json")
    assert code == 0
    returns = {point["arm"]: point["value"] for point in json.loads(out)["returns"]}
    assert set(returns) == {"PETS", "Multi-Headed PETS"}
    assert all(-200 < value < 0 for value in returns.values())
    code, again, _ = run(capsys, *words, "--settings", *settings, "--json")
    assert again == out


def test_experiments_are_listed(capsys):
    code, out, _ = run(capsys, "list", "experiments")
    assert code == 0
    assert all(name in out for name in EXPERIMENTS)
    code, out, _ = run(capsys, "list", "experiments", "--json")
    entries = json.loads(out)["experiments"]
    assert [entry["name"] for entry in entries] == list(EXPERIMENTS)
    assert entries[-1]["arms"][2]["settings"] == {"fitting.oracle": "independent"}
