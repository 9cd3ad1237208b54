"""`headway reproduce` and `headway sweep` on the command line."""

import json
import re

import fakes
import pytest

from headway.cli import main
from headway.lab.paper import EXPERIMENTS
from headway.training.run import RunDir


@pytest.fixture
def run(tmp_path, capsys):
    """Makes the exit code, stdout and stderr of one command."""

    def run(*words):
        options = ("--envs", "pendulum", "--preset", "smoke", "--one-by-one", "--quiet")
        code = main([*words, *options, "--out", str(tmp_path)])
        captured = capsys.readouterr()
        return code, captured.out, captured.err

    return run


def test_reproduce_on_the_command_line(training, run):
    code, out, _ = run("reproduce", "fig13", "--seeds", "0:2")
    assert code == 0
    assert re.search(r"tmcl +2 +41.5 ± 0.7 +– +141.5 ± 0.7", out)
    assert "headway reproduce fig13 --seeds 0:2 --envs pendulum --preset smoke" in out
    code, out, _ = run("reproduce", "fig13", "--seeds", "0:2", "--json")
    facts = json.loads(out)
    assert (code, facts["runs"], facts["failures"], len(facts["files"])) == (0, 4, {}, 4)
    assert {(p["arm"], p["seed"], p["value"]) for p in facts["returns"]} == {
        ("mcl", 0, 31.0), ("mcl", 1, 32.0), ("tmcl", 0, 41.0), ("tmcl", 1, 42.0)
    }  # fmt: skip
    assert len(training.calls) == 4


def test_a_failed_run_is_told_on_stderr_with_exit_code_1(training, run):
    training.answers = {0: [fakes.DIVERGED]}
    code, out, err = run("reproduce", "fig13", "--seeds", "0")
    assert code == 1
    assert "seed0: no finite number" in err
    assert "tmcl" in out


def test_dry_run_lists_and_runs_nothing(training, run, tmp_path):
    words = ("reproduce", "fig15", "--seeds", "0", "--dry-run")
    code, out, _ = run(*words)
    assert code == 0
    assert "5 of 5 runs are missing" in out
    facts = json.loads(run(*words, "--json")[1])
    assert [entry["state"] for entry in facts["runs"]] == ["missing"] * 5
    assert facts["runs"][0]["arms"] == ["M = 1"]
    assert training.calls == []
    assert list(tmp_path.iterdir()) == []


@pytest.mark.usefixtures("training", "without_figures")
def test_sweep_on_the_command_line(run, tmp_path):
    code, out, _ = run(
        "sweep", "--seeds", "5", "--name", "mine", "--methods", "pets", "tmcl", "--json",
        "--settings", "planner.horizon=3,5", "fitting.epochs=1",
    )  # fmt: skip
    assert code == 0
    assert [point["arm"] for point in json.loads(out)["returns"]] == [
        "pets, planner.horizon 3", "pets, planner.horizon 5",
        "tmcl, planner.horizon 3", "tmcl, planner.horizon 5",
    ]  # fmt: skip
    assert "smoke`, fitting.epochs 1, seeds 5" in (tmp_path / "mine-smoke/mine.md").read_text()
    settings = [RunDir(path).config() for path in tmp_path.glob("runs/pendulum/*/seed5")]
    assert sorted(config.planner.horizon for config in settings) == [3, 3, 5, 5]
    assert {config.fitting.epochs for config in settings} == {1}


def test_reproduce_takes_one_value_of_a_setting(run):
    code, _, err = run("reproduce", "fig13", "--settings", "planner.horizon=1,2")
    assert code == 1
    assert "planner.horizon has 2 values, allowed: one" in err


def test_a_real_run_through_the_command_line(run):
    words = ("sweep", "--methods", "random", "--seeds", "0", "--json")
    code, out, _ = run(*words)
    assert code == 0
    (point,) = json.loads(out)["returns"]
    assert point["arm"] == "random"
    assert -2000 < point["value"] < 0
    assert run(*words)[1] == out


def test_experiments_are_listed_with_their_arms(capsys):
    assert main(["list", "experiments", "--json"]) == 0
    entries = json.loads(capsys.readouterr().out)["experiments"]
    assert [entry["name"] for entry in entries] == list(EXPERIMENTS)
    assert entries[-1]["arms"][2]["settings"] == {"planner.selection_length": 10}
