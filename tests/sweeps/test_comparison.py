"""Figure, raw numbers and table of an experiment, and the commands that make them."""

import csv
import dataclasses
import re

import fakes
import numpy as np
import pytest
from matplotlib.figure import Figure
from PIL import Image

from headway.compare import reproduce
from headway.report.comparison.figure import _curves, _dots, arm_styles, has_curves
from headway.report.comparison.runs import Found, Point, _points, find
from headway.report.comparison.verdicts import verdicts
from headway.report.comparison.writing import spread, table_rows, write_table
from headway.sweeps import running
from headway.sweeps.experiments import Arm, Experiment, experiment, sweep_experiment
from headway.sweeps.jobs import Cell, Comparison
from headway.sweeps.running import Workers

HERE = Workers(one_by_one=True)


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
        fakes.write_run(config, path, keep=tested[config.method])

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
