"""Figure, raw numbers and table of an experiment, and the commands that make them."""

import csv
import dataclasses
import json
import re

import fakes
import numpy as np
import pytest
from matplotlib.figure import Figure
from PIL import Image

from headway import compare
from headway.cli import main
from headway.cli.comparisons import read_seeds, read_settings
from headway.cli.usage import UsageError
from headway.compare import reproduce
from headway.report.comparison.figure import _curves, _dots, arm_styles, has_curves
from headway.report.comparison.runs import Found, Point, _points, find
from headway.report.comparison.verdicts import verdicts
from headway.report.comparison.writing import spread, table_rows, write_table
from headway.storage.run_dir import RunDir
from headway.sweeps import running
from headway.sweeps.experiments import EXPERIMENTS, Arm, Experiment, experiment, sweep_experiment
from headway.sweeps.jobs import Cell, Comparison
from headway.sweeps.running import Workers

HERE = Workers(one_by_one=True)
WORDS = ("--envs", "pendulum", "--preset", "smoke", "--one-by-one", "--quiet")


@pytest.fixture
def training(monkeypatch):
    fake = fakes.FakeTraining()
    monkeypatch.setattr(running, "train_run", fake)
    return fake


def comparison(out, name="fig13", seeds=(0, 1, 2), envs=("pendulum",), **settings):
    return Comparison(experiment(name), envs, seeds, "smoke", out, settings)


def rows_of(path):
    with path.open(newline="") as file:
        return list(csv.DictReader(file))


def test_files_stand_beside_each_other_and_hold_what_the_runs_say(training, tmp_path):
    done = reproduce(comparison(tmp_path), workers=HERE, command="headway reproduce fig13")
    folder = tmp_path / "fig13-smoke"
    assert sorted(path.name for path in done.files) == [
        "fig13.csv", "fig13.md", "fig13.png", "fig13.svg"
    ]  # fmt: skip
    assert {path.parent for path in done.files} == {folder}
    rows = rows_of(folder / "fig13.csv")
    # 2 arms, 3 seeds, 2 iterations, training physics and 2 unseen groups, 2 episodes
    assert len(rows) == 2 * 3 * 2 * 3 * 2
    unseen = [
        float(row["return"])
        for row in rows
        if (row["arm"], row["seed"], row["iteration"]) == ("MCL", "2", "1")
        and row["group"] != "train"
    ]
    assert np.mean(unseen) == 30 + 2 + 1  # see fakes.level
    assert all((tmp_path / row["run"] / "config.json").exists() for row in rows)
    table = (folder / "fig13.md").read_text()
    spread_of_three = r"32.0 \(3[1-3][.\d]* to 3[1-3][.\d]*\)"
    assert re.search(
        rf"\| MCL \| 3 \| 32.0 ± 1.0 \| {spread_of_three} \| 132.0 ± 1.0 \| – \|", table
    )
    assert "| T-MCL | 3 | 42.0 ± 1.0 | 42.0 (4" in table
    # All of T-MCL's runs are above all of MCL's, which three seeds show by chance as well.
    assert "- 3 seeds: too few to show that T-MCL and MCL differ (the clearest result has" in table
    assert "; T-MCL is above MCL in every pair of runs." in table
    assert "- Intervals from fewer than 10 seeds are too narrow" in table
    assert "    headway reproduce fig13\n" in table
    assert "no difference between arms can be claimed" not in table


def test_figures_have_ink_and_svg_names_the_arms(training, tmp_path):
    envs = ("pendulum", "hopper", "half-cheetah", "cartpole-swingup")
    done = reproduce(comparison(tmp_path, envs=envs, seeds=(0, 1)), workers=HERE)
    png, svg = (tmp_path / "fig13-smoke" / f"fig13.{kind}" for kind in ("png", "svg"))
    pixels = np.asarray(Image.open(png).convert("L"))
    assert 0.005 < (pixels < 200).mean() < 0.6
    first = svg.read_bytes()
    assert first.startswith(b"<?xml")
    assert first.count(b"<!-- T-MCL -->") == 1  # matplotlib names drawn texts in comments
    assert has_curves(done.found)
    svg.unlink()
    reproduce(comparison(tmp_path, envs=envs, seeds=(0, 1)), workers=HERE)
    assert svg.read_bytes() == first


def test_one_test_per_run_is_drawn_as_dots(training, tmp_path):
    asked = comparison(tmp_path, **{"collection.num_iterations": 1})
    done = reproduce(asked, workers=HERE)
    assert not has_curves(done.found)
    assert b"<!-- T-MCL -->" in (tmp_path / "fig13-smoke/fig13.svg").read_bytes()


def test_arms_of_different_length_that_are_tested_once_are_dots(training, tmp_path, monkeypatch):
    def last_only(config, path, progress):
        fakes.write_run(config, path)
        kept = [row for row in RunDir(path).evaluation() if row.iteration == tested[config.method]]
        (path / "evaluation.csv").unlink()
        RunDir(path).append_evaluation(kept)

    tested = {"mcl": 0, "tmcl": 1}
    monkeypatch.setattr(running, "train_run", last_only)
    done = reproduce(comparison(tmp_path, seeds=(0,)), workers=HERE)
    assert [(p.arm, p.iteration) for p in done.found.points] == [("MCL", 0), ("T-MCL", 1)]
    assert not has_curves(done.found)
    assert [point.arm for point in done.found.final_points] == ["MCL", "T-MCL"]


def test_what_learns_nothing_is_a_level_beside_curves(tmp_path):
    points = [Point("pendulum", "MCL", 0, 0, 0, -900.0)]
    points += [Point("pendulum", "T-MCL", 0, i, 20 * i + 20, -500.0 - i) for i in range(3)]
    found = Found(comparison(tmp_path, seeds=(0,)), [], points, [])
    assert has_curves(found)
    axes = Figure().subplots()
    _curves(axes, found, "pendulum")
    level, curve = axes.get_lines()
    assert list(level.get_ydata()) == [-900.0, -900.0]
    assert list(curve.get_xdata()) == [20, 40, 60]


def test_an_episode_that_was_cut_bends_no_curve(tmp_path):
    points = [
        Point("pendulum", "T-MCL", seed, i, 20 * i + 20 - 6 * (seed == i == 1), 10.0 * i + 2 * seed)
        for seed in range(3)
        for i in range(3)
    ]
    axes = Figure().subplots()
    _curves(axes, Found(comparison(tmp_path), [], points, []), "pendulum")
    (curve,) = axes.get_lines()
    assert list(curve.get_xdata()) == [20, 38, 60]
    assert list(curve.get_ydata()) == [2, 12, 22]
    edges = axes.collections[0].get_paths()[0].vertices
    assert {float(y) for x, y in edges if x == 38} == {10.0, 14.0}  # one standard deviation


def test_training_curves_show_what_was_collected(training, tmp_path):
    done = reproduce(comparison(tmp_path, "fig9", seeds=(0,)), workers=HERE)
    rows = rows_of(tmp_path / "fig9-smoke/fig9.csv")
    assert {row["group"] for row in rows} == {"collected"}
    points = done.found.of("pendulum", "T-MCL")
    assert [(point.iteration, point.value) for point in points] == [(0, 40.0), (1, 41.0)]


def test_few_seeds_and_missing_runs_are_said(training, tmp_path):
    training.answers = {1: [fakes.DIVERGED]}
    done = reproduce(comparison(tmp_path, seeds=(0, 1)), workers=HERE)
    assert len(done.failures) == 1
    assert [tuple(cell) for cell in done.found.missing] == [("pendulum", "MCL", 1)]
    table = (tmp_path / "fig13-smoke/fig13.md").read_text()
    assert "is better than" not in table
    assert "Fewer than 3 seeds: no difference between arms can be claimed." in table
    assert "Not finished: pendulum, MCL, seed 1." in table
    assert "| MCL | 1 | 31.0 | – | 131.0 | – |" in table


def test_arms_are_compared_over_groups_and_environments_of_both(training, tmp_path):
    training.answers = {0: [fakes.DIVERGED]}
    done = reproduce(comparison(tmp_path, envs=("pendulum", "half-cheetah")), workers=HERE)
    assert [tuple(cell) for cell in done.found.missing] == [("pendulum", "MCL", 0)]
    returns = {1: 32, 2: 33}
    assert done.found.run_returns("pendulum", "MCL") == {"low": returns, "high": returns}
    (line,) = verdicts(done.found)
    assert line.startswith("2 seeds: too few to show that T-MCL and MCL differ")


def test_arms_that_were_not_tested_alike_are_not_compared(training, tmp_path):
    arms = (Arm("short"), Arm("long", settings={"collection.episode_length": 30}))
    asked = Comparison(
        Experiment("own", "lengths", arms), ("pendulum",), (0, 1, 2), "smoke", tmp_path
    )
    lines = verdicts(reproduce(asked, workers=HERE).found)
    assert lines == [
        "Not compared with short, because physics, episode lengths or options of the environment"
        " differ: long on pendulum."
    ]


def test_physics_count_once_however_many_episodes_they_have(training, tmp_path):
    found = reproduce(comparison(tmp_path, seeds=(0,)), workers=HERE).found
    place = {"env": "pendulum", "arm": "T-MCL", "seed": 0, "iteration": 1, "group": "low"}
    rows = [
        {**place, "sim_params": physics, "return": value}
        for physics, value in (("length=0.25", 0.0), ("length=0.375", 6.0), ("length=0.375", 8.0))
    ]
    one = dataclasses.replace(found, rows=rows)
    assert one.run_returns("pendulum", "T-MCL") == {"low": {0: 3.5}}
    cell = Cell("pendulum", "T-MCL", 0)
    (point,) = _points(found.comparison, cell, [{**row, "timesteps": 20} for row in rows])
    assert point.value == 3.5


def test_settings_are_resolved_once_for_all_lines(training, tmp_path, monkeypatch):
    found = reproduce(comparison(tmp_path, seeds=(0,)), workers=HERE).found
    calls, cells = [], Comparison.cells.fget
    monkeypatch.setattr(Comparison, "cells", property(lambda self: calls.append(1) or cells(self)))
    write_table(dataclasses.replace(found), "")
    assert len(calls) == 1


def test_another_figure_reuses_the_runs(training, tmp_path):
    reproduce(comparison(tmp_path, seeds=(0,)), workers=HERE)
    before = len(training.calls)
    done = reproduce(comparison(tmp_path, "fig15", seeds=(0,)), workers=HERE)
    assert (before, len(training.calls)) == (2, 2 + 3)
    assert len(done.found.final_points) == 5


@pytest.fixture
def without_figures(monkeypatch):
    """Figures take long to draw."""
    monkeypatch.setattr(compare, "draw_comparison", lambda found: [])


@pytest.mark.usefixtures("training", "without_figures")
def test_a_comparison_replaces_what_it_contains_and_nothing_else(tmp_path):
    board = fakes.Remembering()

    def make(**changes):
        options = {"seeds": (0,), **changes}
        done = reproduce(comparison(tmp_path, **options), workers=HERE, board=board)
        return done.files[-1].parent

    usual = make()
    assert make() == make(seeds=(0, 1)) == make(seeds=(1, 0), envs=("hopper", "pendulum")) == usual
    assert board.messages == []
    both = (usual / "fig13.csv").read_bytes()
    other = make(envs=("hopper",))
    assert re.fullmatch(r"fig13-smoke-[0-9a-f]{10}", other.name)
    assert board.messages == [
        f"{usual} holds another comparison, which stays; this one goes to {other}"
    ]
    horizon = {"planner.horizon": 2}
    assert len({usual, other, make(envs=("slim-humanoid",)), make(**horizon)}) == 4
    assert make(envs=("hopper",)) == other
    assert (usual / "fig13.csv").read_bytes() == both
    (usual / "comparison.json").write_text("{")
    assert make(seeds=(0, 1), envs=("pendulum", "hopper")) != usual


@pytest.mark.usefixtures("training", "without_figures")
def test_sweeps_of_the_same_name_do_not_replace_each_other(tmp_path, capsys):
    words = ("sweep", *WORDS, "--seeds", "0", "--out", str(tmp_path), "--json")
    files = [
        json.loads(run(capsys, *words, "--methods", *methods)[1])["files"]
        for methods in (["pets"], ["pets", "tmcl"], ["mcl"])
    ]
    assert files[0] == files[1] != files[2]


def test_nothing_finished_makes_no_figure_but_a_table(tmp_path):
    found = find(comparison(tmp_path))
    assert len(found.missing) == 6
    assert found.points == []


def test_spread_is_over_seeds():
    assert spread([]) == "–"
    assert spread([1234.5]) == "1,234.5"
    assert spread([1.0, 3.0]) == "2.0 ± 1.4"


def test_many_arms_can_be_told_apart():
    for arms in ([Arm(f"arm {i}") for i in range(20)], experiment("comparison").arms):
        styles = arm_styles(arms)
        assert len(set(styles.values())) == len(arms)


def test_a_method_looks_the_same_in_every_figure():
    named = [arm_styles(experiment(name).arms) for name in ("comparison", "fig10", "fig13")]
    for styles in named[1:]:
        assert styles.items() <= named[0].items()
    own = sweep_experiment("own", ["pets", "tmcl"], {})
    assert arm_styles(own.arms).items() <= named[0].items()
    heads = arm_styles(experiment("fig14").arms)  # of one method
    assert len(set(heads.values())) == len(heads)


def test_dots_stand_in_the_order_of_results_beside_their_scores(training, tmp_path):
    changed = {"collection.num_iterations": 1, "collection.episode_length": 200}
    found = reproduce(comparison(tmp_path, **changed), workers=HERE).found
    axes = Figure().subplots()
    _dots(axes, found, "pendulum")
    assert [text.get_text() for text in axes.get_yticklabels()] == ["T-MCL", "MCL"]
    assert axes.get_xlabel() == "return per episode, unseen physics"
    scores = [text.get_text() for text in axes.texts]
    rows = table_rows(found, "pendulum")
    assert scores == [rows[1][-1], rows[0][-1], "score"]
    assert "–" not in scores
    dots = [line for line in axes.get_lines() if len(line.get_xdata()) == 3]
    assert [line.get_color() for line in dots] == [
        arm_styles(found.comparison.experiment.arms)[name][0] for name in ("T-MCL", "MCL")
    ]


def test_arms_of_one_method_keep_their_order_and_titles_are_for_readers(training, tmp_path):
    asked = comparison(tmp_path, "fig12", seeds=(0,), **{"collection.num_iterations": 1})
    found = reproduce(asked, workers=HERE).found
    axes = Figure().subplots()
    _dots(axes, found, "pendulum")
    names = [text.get_text() for text in axes.get_yticklabels()]
    assert names == ["with context", "without context"]
    drawn = (tmp_path / "fig12-smoke/fig12.svg").read_text()
    assert "<!-- With and without context learning, pendulum -->" in drawn
    assert "fig12" not in drawn


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
    assert [entry["state"] for entry in facts["runs"]] == ["waiting"] * 5
    assert facts["runs"][0]["arms"] == ["M = 1"]
    assert facts["note"] == ""
    words = ("reproduce", "comparison", *words[2:])
    assert "missing runs that plan on the true dynamics" in run(capsys, *words)[1]
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


@pytest.mark.parametrize(
    ("words", "seeds"), [(["0:3"], (0, 1, 2)), (["4"], (4,)), (["1", "7:9"], (1, 7, 8))]
)
def test_seeds(words, seeds):
    assert read_seeds(words) == seeds


@pytest.mark.parametrize("word", ["x", "3:3", "3:1", "-1", "0:99999999", "1:2:3"])
def test_bad_seeds(word):
    with pytest.raises(UsageError, match=r"--seeds is .*allowed"):
        read_seeds([word])


def test_settings_are_json_or_text():
    words = ["model.hidden_sizes=[8,8],[9]", "planner.head-selection=average", "a=1,2.5"]
    words += ['env_options={"x":true,"y":false},{"x":false}', "b=[[1,2],[3]]", "c=1, x,2.y,1e5z"]
    assert read_settings(words) == {
        "model.hidden_sizes": [[8, 8], [9]],
        "planner.head_selection": ["average"],
        "a": [1, 2.5],
        "env_options": [{"x": True, "y": False}, {"x": False}],
        "b": [[[1, 2], [3]]],
        "c": [1, "x", "2.y", "1e5z"],
    }


BAD_SETTINGS = ["a", "a=", "=1", "a=1,", "a=x,,y", "a=,", "a=[8,8", 'a={"x":true', "a=[1]2"]


@pytest.mark.parametrize("words", [*([word] for word in BAD_SETTINGS), ["a=1", "a=2"]])
def test_bad_settings(words):
    with pytest.raises(UsageError, match=r"--settings is"):
        read_settings(words)


def test_reproduce_takes_one_value_of_a_setting(tmp_path, capsys):
    words = ("reproduce", "fig13", *WORDS, "--settings", "planner.horizon=1,2")
    code, _, err = run(capsys, *words)
    assert code == 2
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
