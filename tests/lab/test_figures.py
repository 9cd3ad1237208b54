"""The figures of a run."""

import json

import fakes
import matplotlib
import numpy as np
import pandas as pd
import pytest
from matplotlib.figure import Figure
from PIL import Image

from headway.lab import figures
from headway.lab.figures import save_run_figures
from headway.lab.paper import Arm, experiment, sweep_experiment
from headway.lab.report import write_report
from headway.sim_params import SimParamSets, Uniform
from headway.training.methods import METHODS

TABLES = ["metrics.jsonl", "evaluation.csv", "assignments.csv", "prediction_error.csv"]
ALL = ["learning_curve.png", "evaluation.png", "head_shares.png", "prediction_error.png"]


def test_every_figure_is_drawn_and_settings_of_the_user_stay(run_dir):
    before = dict(matplotlib.rcParams)
    paths = save_run_figures(run_dir)
    assert [path.name for path in paths] == ALL
    for path in paths:
        assert path.parent == run_dir / "figures"
        pixels = np.asarray(Image.open(path).convert("L"))
        assert pixels.shape[0] > 400
        assert 0.005 < (pixels < 200).mean() < 0.6
    assert dict(matplotlib.rcParams) == before


def test_physics_of_any_name_and_range_are_drawn(tmp_path):
    values = {"pole, x [$m$]=1": Uniform(0.5, 1.0), "mass\n<b>_2": (1.0, 2.0)}
    sets = SimParamSets(values, {"low": values, "high": values})
    run = fakes.write(tmp_path / "run", iterations=1, sim_params=sets)
    assert [path.name for path in save_run_figures(run)] == ALL
    assert write_report([run], tmp_path / "report.html").exists()


@pytest.mark.parametrize(("missing", "figure"), list(zip(TABLES, ALL, strict=True)))
def test_a_missing_file_leaves_its_figure_out(run_dir, missing, figure):
    (run_dir / missing).unlink()
    names = [path.name for path in save_run_figures(run_dir)]
    assert names == [name for name in ALL if name != figure]


def test_one_iteration_one_head_diverged_predictions(tmp_path):
    path = fakes.write(tmp_path / "run", iterations=1, heads=1)
    table = path / "prediction_error.csv"
    table.write_text(table.read_text() + "0,low,21,1e6\n0,low,22,nan\n0,far,1,inf\n")
    (line,) = (path / "metrics.jsonl").read_text().splitlines()
    (path / "metrics.jsonl").write_text(json.dumps(json.loads(line) | {"evaluation": {}}))
    names = [figure.name for figure in save_run_figures(path)]
    assert names == [name for name in ALL if name != "head_shares.png"]


def drawn_curves(*values, finished=(True, True, True), steps=20):
    """Axes with the curves of one label, from the returns of each seed by iteration."""
    table = pd.DataFrame(
        [
            {"label": "A", "run": str(seed), "iteration": i, "timesteps": steps * (i + 1),
             "return": value, "finished": finished[seed]}
            for seed, returns in enumerate(values)
            for i, value in enumerate(returns)
        ]
    )  # fmt: skip
    axes = Figure().subplots()
    figures.curves(axes, table, {"A": figures.look(0)})
    return axes


def test_curves_have_a_band_from_three_seeds_on():
    two = drawn_curves([0, 10], [2, 12])
    assert not two.collections
    assert len(two.get_lines()) == 3  # a thin line per seed
    three = drawn_curves([0, 10], [2, 12], [4, 14])
    assert len(three.collections) == 1
    (line,) = three.get_lines()
    assert list(line.get_ydata()) == [2, 12]


def test_unfinished_runs_are_no_part_of_the_mean():
    lines = drawn_curves([0, 10], [99], finished=(True, False)).get_lines()
    assert [list(line.get_ydata()) for line in lines] == [[99], [0, 10]]


def test_what_learns_nothing_is_a_level():
    (line,) = drawn_curves([5.0], steps=0).get_lines()
    assert list(line.get_ydata()) == [5.0, 5.0]


def test_dots_mark_every_run_and_no_interval_of_two():
    for values, marks in (([1.0, 2.0], 2), ([1.0, 2.0, 3.0], 3)):
        axes = Figure().subplots()
        table = pd.DataFrame({"label": "A", "value": values})
        figures.dots(axes, table, {"A": figures.look(0), "B": figures.look(1)}, "score")
        assert len(axes.get_lines()) == marks  # an interval, dots, their mean
        assert [text.get_text() for text in axes.get_yticklabels()] == ["A", "B"]


def test_a_method_looks_the_same_in_every_figure_and_arms_differ():
    named = [figures.arm_looks(experiment(name).arms) for name in ("comparison", "fig10", "fig13")]
    for looks in named[1:]:
        assert looks.items() <= named[0].items()
    assert figures.arm_looks(sweep_experiment("own", ["pets", "tmcl"], {}).arms).items() <= (
        named[0].items()
    )
    for arms in (experiment("comparison").arms, [Arm(f"arm {i}") for i in range(len(METHODS))]):
        looks = figures.arm_looks(arms).values()
        assert len({tuple(look.values()) for look in looks}) == len(arms)
