"""The scripts behind `results/`: they run, go on where they were, and tell arms apart."""

import re
import runpy
import shutil
import sys
from pathlib import Path

import numpy as np
import pytest

import headway
from headway import settings
from headway.cli import main
from headway.errors import RunError
from headway.experiment.loading import load_learned
from headway.storage import config_file
from headway.storage.records import read_csv
from headway.storage.run_dir import RunDir
from headway.storage.tables import TABLES

RESULTS = Path(__file__).parents[1] / "results"
SCRIPTS = RESULTS / "adaptation"
FINISHED = RESULTS / "pendulum-quick" / "tmcl" / "seed-0"


@pytest.fixture(scope="module")
def run_dir(tmp_path_factory):
    path = tmp_path_factory.mktemp("trained") / "tmcl"
    settings = {"evaluation.num_episodes": 2, "collection.episode_length": 45}
    headway.train("pendulum", preset="smoke", run_dir=path, settings=settings)
    return path


@pytest.fixture
def run_script(monkeypatch):
    """Call a script as from the command line; returns its names."""
    monkeypatch.syspath_prepend(str(SCRIPTS))
    forget_scripts()

    def run(name, *words):
        monkeypatch.setattr(sys, "argv", [name, *map(str, words)])
        return runpy.run_path(str(SCRIPTS / name), run_name="__main__")

    yield run
    forget_scripts()


def forget_scripts():
    """Other folders have scripts of the same names."""
    for script in SCRIPTS.glob("*.py"):
        sys.modules.pop(script.stem, None)


def test_rules_of_selection_are_compared_on_the_same_episodes(run_dir, run_script, tmp_path):
    table = tmp_path / "selection.csv"
    rules = ["last 10", "random", "last layer; corrected heads, last 10"]
    found = run_script("selection.py", run_dir, "--table", table, "--rules", *rules)
    rows = read_csv(table, found["COLUMNS"])
    assert len(rows) == 3 * len(rules)
    low = [row for row in rows if row["group"] == "low"]
    assert len({row["average_error"] for row in low}) == 2  # frozen heads, and those that learn
    errors = {row["rule"]: float(row["chosen_error"]) for row in low}
    assert errors[rules[2]] < errors["last 10"]
    known = {row["rule"]: float(row["chosen_error"]) for row in rows if row["group"] == "train"}
    assert known[rules[2]] < 0.5 * known["last 10"]


def test_arms_and_changes_of_physics(run_dir, run_script, tmp_path, capsys):
    words = [run_dir, "--folder", tmp_path, "--arms", "none", "last-layer", "--step", 20]
    found = run_script("changes.py", *words)
    rows = read_csv(tmp_path / "tmcl.csv", found["COLUMNS"])
    changes = found["CHANGES"]["pendulum"]
    assert [row["arm"] for row in rows] == len(changes) * ["none"] + len(changes) * ["last-layer"]
    frozen, learning = ([row["return_after"] for row in rows if row["arm"] == arm]
                        for arm in ("none", "last-layer"))  # fmt: skip
    assert frozen != learning
    assert all(0 <= float(row["recovery_steps"]) <= 25 for row in rows)
    capsys.readouterr()
    run_script("changes.py", *words)
    assert capsys.readouterr().out == ""  # nothing was missing
    figure = tmp_path / "changes.png"
    run_script("by_change.py", tmp_path, figure)
    assert "| length 0.5 → 1.25 in 100 steps |" in capsys.readouterr().out
    assert figure.stat().st_size > 10_000


def test_returns_of_methods_by_physics(run_script, capsys):
    folder = SCRIPTS / "pendulum-quick"
    found = run_script("by_method.py", folder, "--by-physics")
    header, _, *lines = capsys.readouterr().out.splitlines()
    assert header.split("|")[3:7] == [" 0.5 ", " 0.75 ", " 1 ", " 1.25 "]
    rows = [row for path in folder.glob("tmcl-*.csv") for row in read_csv(path, found["COLUMNS"])]
    longest = [float(row["return_mean"]) for row in rows
               if row["arm"] == "none" and "1.75" in row["sim_params"]]  # fmt: skip
    assert len(longest) == 3
    [line] = [line for line in lines if line.startswith("| `tmcl` | frozen heads |")]
    assert line.split("|")[-2] == f" {np.mean(longest):.0f} "


def test_what_runs_earn_while_collecting(run_script, tmp_path, capsys):
    other = RESULTS / "pendulum-collecting" / "tmcl-bayes" / "seed-0"
    figure = tmp_path / "collecting.png"
    run_script("collecting.py", FINISHED, other, "--figure", figure)
    first, second = capsys.readouterr().out.splitlines()[2:]
    last = RunDir(other).metrics()[-1]["collection"]["return_mean"]
    assert second.startswith("| `tmcl-bayes` | 0 | ")
    assert second.endswith(f" {last:.0f} |")
    assert first.split("|")[3] == second.split("|")[3]  # both acted at random, with the same seed
    assert figure.stat().st_size > 10_000


@pytest.mark.usefixtures("run_script")
def test_recovery_of_a_pendulum():
    recovery_steps = runpy.run_path(str(SCRIPTS / "changes.py"))["recovery_steps"]
    reward = [0.0] * 50 + [-8.0] * 30 + [-0.1] * 70
    assert recovery_steps("pendulum", reward, 50) == 29  # one bad step of 20 is let pass
    assert recovery_steps("pendulum", reward[:90], 50) == 40
    assert recovery_steps("half-cheetah", [2.0] * 50 + [0.0] * 5 + [2.0] * 60, 50) == 3


@pytest.mark.usefixtures("run_script")
def test_a_drift_goes_to_its_end_in_equal_steps():
    lengths = runpy.run_path(str(SCRIPTS / "changes.py"))["lengths"]
    assert lengths(1.0, 0.5).schedule(20) == {20: {"length": 0.5}}
    drift = lengths(0.5, 1.5, over=4).schedule(20)
    assert drift == {20 + i: {"length": 0.75 + 0.25 * i} for i in range(4)}


@pytest.fixture
def keep():
    """The function of `results/keep.py`."""
    return runpy.run_path(str(RESULTS / "keep.py"))["keep"]


def variant(path, **changes):
    """A finished run of other settings; only what is kept of it is there."""
    shutil.copytree(FINISHED, path)
    config = settings.override(RunDir(path).config(), changes)
    (path / "config.json").write_bytes(config_file.content(config))
    return RunDir(path)


def test_what_all_kept_runs_share_names_no_arm(keep, tmp_path):
    length = {"collection.episode_length": 150}
    run = variant(tmp_path / "shorter", **length)
    assert keep(run, tmp_path / "a", length).parent.name == "tmcl"
    assert keep(run, tmp_path / "b").parent.name.startswith("tmcl-")


def test_what_is_kept_of_a_run_can_be_reported_but_not_used(keep, tmp_path, capsys):
    kept = keep(RunDir(FINISHED), tmp_path / "kept")
    assert kept == tmp_path / "kept" / "tmcl" / "seed-0"
    names = {path.relative_to(kept).as_posix() for path in kept.rglob("*") if path.is_file()}
    assert "manifests/iteration-004.json" in names
    assert not any(name.startswith(("checkpoints", "data", "tests")) for name in names)
    assert len(RunDir(kept).metrics()) == 5
    out = tmp_path / "report.html"
    words = ["report", str(kept), "-o", str(out), "--only", "results", "contexts"]
    assert main(words) == 0
    page = out.read_text()
    assert "iterations are finished" not in page
    assert "seed-0 is a copy without checkpoints, allowed: a run with them" in page
    with pytest.raises(RunError, match="is a copy without checkpoints"):
        headway.load(kept)


def test_another_variant_is_kept_beside(keep, tmp_path):
    run = variant(tmp_path / "faster", **{"fitting.learning_rate": 5e-4})
    averaged = variant(tmp_path / "averaged", **{"planner.head_selection": "average"})
    folder = tmp_path / "kept"
    names = [keep(one, folder).parent.name for one in (RunDir(FINISHED), run, averaged)]
    assert names[0] == "tmcl"
    assert re.fullmatch(r"tmcl-[0-9a-f]{10}", names[1])
    assert names[2] == "tmcl-average"
    assert keep(run, folder).parent.name == names[1]
    shutil.copyfile(run.path / "config.json", folder / "tmcl" / "seed-0" / "config.json")
    with pytest.raises(SystemExit, match=r"is of another run .*fitting.learning_rate"):
        keep(RunDir(FINISHED), folder)


def test_what_was_kept_can_be_read():
    runs = sorted((RESULTS / "pendulum-quick").glob("*/seed-*"))
    assert len(runs) == 27
    for path in runs:
        run = RunDir(path)
        assert run.finished_iterations == run.config().collection.num_iterations == 5
        manifest = run.manifest()
        assert manifest is not None
        manifest.check(path, ["config.json", *TABLES])


def forward_heads(path):
    """Mean weights of the forward network [member, head, in, out] in the last checkpoint."""
    run = RunDir(path)
    return load_learned(run, run.config()).fit.model.forward_net.mean_heads.weight


def test_pruning_leaves_the_heads_that_own_something(run_dir, run_script, tmp_path, capsys):
    run_script("prune.py", run_dir, tmp_path / "all", "--min-share", 0)
    np.testing.assert_array_equal(forward_heads(tmp_path / "all"), forward_heads(run_dir))
    run_script("prune.py", run_dir, tmp_path / "most", "--min-share", 1.1)
    assert "heads left: 1 1" in capsys.readouterr().out
    for before, after in zip(forward_heads(run_dir), forward_heads(tmp_path / "most"), strict=True):
        assert (np.asarray(after) == np.asarray(after)[:1]).all()
        assert any((one == after[0]).all() for one in before)
    headway.evaluate(tmp_path / "most", num_episodes=1, groups=["low"])


@pytest.mark.usefixtures("run_script")
def test_a_head_that_owns_one_physics_stays():
    replacements = runpy.run_path(str(SCRIPTS / "prune.py"))["replacements"]
    owned = np.array([[[0.7, 0.95], [0.2, 0.0], [0.1, 0.05]]])  # one member, heads by physics
    assert replacements(owned, 0.2).tolist() == [[0, 1, 0]]
    assert replacements(owned, 0.1).tolist() == [[0, 1, 2]]
    assert replacements(owned, 0.3).tolist() == [[0, 0, 0]]


def test_foresight_is_measured_once_and_drawn(run_dir, run_script, tmp_path, capsys):
    words = [run_dir, "--table", tmp_path / "fore.csv", "--figure", tmp_path / "fore.png"]
    found = run_script("foresight.py", *words)
    printed = capsys.readouterr().out
    rows = read_csv(tmp_path / "fore.csv", found["COLUMNS"])
    errors = {row["head"]: [] for row in rows}
    for row in rows:
        errors[row["head"]].append(float(row["relative_error"]))
    assert set(errors) == {"owner", "runner-up"}
    for of_head in errors.values():
        assert of_head[0] == pytest.approx(1.0, abs=0.01)  # the least ratio learns nothing
        assert min(of_head) < 1.0
    (tmp_path / "fore.png").unlink()
    run_script("foresight.py", *words)
    assert capsys.readouterr().out == printed
    assert (tmp_path / "fore.png").stat().st_size > 10_000
