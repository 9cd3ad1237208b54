"""Figure, raw numbers and table of an experiment, and the commands that make them."""

import dataclasses
import re

import fakes
import numpy as np
import pandas as pd
import pytest
from PIL import Image

from headway.errors import RunError
from headway.lab.comparison import draw, find, reproduce, table, verdicts
from headway.lab.paper import Arm, Experiment, sweep_experiment
from headway.lab.sweep import Workers

HERE, THREE = Workers(one_by_one=True), (0, 1, 2)


def compare(out, name="fig13", seeds=(0,), command="", **asked):
    return reproduce(
        fakes.comparison(out, name, seeds=seeds, **asked), workers=HERE, command=command
    )


def test_files_stand_beside_each_other_and_hold_what_the_runs_say(training, tmp_path):
    done = compare(tmp_path, seeds=THREE, command="headway reproduce fig13")
    folder = tmp_path / "fig13-smoke"
    assert sorted(path.name for path in done.files) == [
        "fig13.csv", "fig13.md", "fig13.png", "fig13.svg"
    ]  # fmt: skip
    assert {path.parent for path in done.files} == {folder}
    rows = pd.read_csv(folder / "fig13.csv")
    # 2 arms, 3 seeds, 2 iterations, training physics and 2 unseen groups, 2 episodes
    assert len(rows) == 2 * 3 * 2 * 3 * 2
    unseen = rows.query("arm == 'mcl' and seed == 2 and iteration == 1 and group != 'train'")
    assert unseen["return"].mean() == 30 + 2 + 1  # see fakes.level
    assert all((tmp_path / run / "config.json").exists() for run in rows.run)
    text = (folder / "fig13.md").read_text()
    spread_of_three = r"32.0 \(3[1-3][.\d]* to 3[1-3][.\d]*\)"
    assert re.search(
        rf"\| mcl \| 3 \| 32.0 ± 1.0 \| {spread_of_three} \| 132.0 ± 1.0 \| – \|", text
    )
    assert "| tmcl | 3 | 42.0 ± 1.0 | 42.0 (4" in text
    # All of tmcl's runs are above all of mcl's, which three seeds show by chance as well.
    assert "- 3 seeds: too few to show that tmcl and mcl differ (the clearest result has" in text
    assert "; tmcl is above mcl in every pair of runs." in text
    assert "- Intervals from fewer than 10 seeds are too narrow" in text
    assert "    headway reproduce fig13\n" in text
    assert "no difference between arms can be claimed" not in text


def test_figures_have_ink_and_svg_names_the_arms(training, tmp_path):
    envs = ("pendulum", "hopper", "half-cheetah", "cartpole-swingup")
    done = compare(tmp_path, envs=envs, seeds=(0, 1))
    png, svg = (tmp_path / "fig13-smoke" / f"fig13.{kind}" for kind in ("png", "svg"))
    pixels = np.asarray(Image.open(png).convert("L"))
    assert 0.005 < (pixels < 200).mean() < 0.6
    first = svg.read_bytes()
    assert first.startswith(b"<?xml")
    assert first.count(b"<!-- tmcl -->") == 1  # matplotlib names drawn texts in comments
    svg.unlink()
    draw(done)
    assert svg.read_bytes() == first


def test_training_curves_show_what_was_collected(training, tmp_path):
    done = compare(tmp_path, "fig9")
    assert {*pd.read_csv(tmp_path / "fig9-smoke/fig9.csv").group} == {"collected"}
    points = done.points.query("label == 'tmcl'")
    assert list(zip(points.iteration, points["return"], strict=True)) == [(0, 40.0), (1, 41.0)]


def test_few_seeds_and_missing_runs_are_said(training, tmp_path):
    training.answers = {1: [fakes.DIVERGED]}
    done = compare(tmp_path, seeds=(0, 1))
    assert len(done.failures) == 1
    assert done.missing == [("pendulum", "mcl", 1)]
    text = (tmp_path / "fig13-smoke/fig13.md").read_text()
    assert "is better than" not in text
    assert "Fewer than 3 seeds: no difference between arms can be claimed." in text
    assert "Not finished: pendulum, mcl, seed 1." in text
    assert "| mcl | 1 | 31.0 | – | 131.0 | – |" in text


def test_arms_are_compared_over_groups_and_environments_of_both(training, tmp_path):
    training.answers = {0: [fakes.DIVERGED]}
    done = compare(tmp_path, envs=("pendulum", "half-cheetah"), seeds=THREE)
    assert done.missing == [("pendulum", "mcl", 0)]
    parts = done.parts.query("env == 'pendulum' and label == 'mcl' and group == 'low'")
    assert parts.groupby("seed").return_mean.mean().to_dict() == {1: 32, 2: 33}
    (line,) = verdicts(done)
    assert line.startswith("2 seeds: too few to show that tmcl and mcl differ")


def test_arms_that_were_not_tested_alike_are_not_compared(training, tmp_path):
    arms = (Arm("short"), Arm("long", settings={"collection.episode_length": 30}))
    lines = verdicts(compare(tmp_path, Experiment("own", "lengths", arms), seeds=THREE))
    assert lines == [
        "Not compared with short, because physics, episode lengths or options of the environment"
        " differ: long on pendulum."
    ]


def test_physics_count_once_however_many_episodes_they_have(training, tmp_path):
    found = compare(tmp_path)
    rows = found.episodes.query("label == 'tmcl' and group == 'low' and iteration == 1")
    rows = rows.iloc[[0, 0, 0]].assign(**{
        "sim_params": ["length=0.25 mass=1", "length=0.375 mass=1", "length=0.375 mass=1"],
        "return": [0.0, 6.0, 8.0],
    })  # fmt: skip
    (point,) = dataclasses.replace(found, episodes=rows).points["return"]
    assert point == 3.5


@pytest.mark.usefixtures("training", "without_figures")
def test_a_comparison_replaces_what_it_contains_and_nothing_else(tmp_path):
    def make(**changes):
        return compare(tmp_path, **changes).files[-1].parent

    usual = make()
    assert make() == make(seeds=(0, 1)) == make(seeds=(1, 0), envs=("hopper", "pendulum")) == usual
    both = (usual / "fig13.csv").read_bytes()
    other = make(envs=("hopper",))
    assert re.fullmatch(r"fig13-smoke-[0-9a-f]{10}", other.name)
    horizon = {"planner.horizon": 2}
    assert len({usual, other, make(envs=("slim-humanoid",)), make(**horizon)}) == 4
    assert make(envs=("hopper",)) == other
    assert (usual / "fig13.csv").read_bytes() == both
    own = [
        make(name=sweep_experiment("own", methods, {}))
        for methods in (["pets"], ["pets", "tmcl"], ["mcl"])
    ]
    assert own[0] == own[1] != own[2]
    (usual / "comparison.json").write_text("{}")
    assert make(seeds=(0, 1), envs=("pendulum", "hopper")) != usual
    for damaged in ("{", "[1]"):
        (usual / "comparison.json").write_text(damaged)
        with pytest.raises(RunError, match=r"comparison\.json is damaged"):
            make()


def test_nothing_finished_makes_no_figure_but_a_table(training, tmp_path):
    training.answers = {0: [fakes.DIVERGED] * 2}
    done = compare(tmp_path)
    assert [path.suffix for path in done.files] == [".csv", ".md"]
    assert len(find(fakes.comparison(tmp_path)).missing) == 2
    assert "| mcl | 0 | – | – | – | – |" in done.files[-1].read_text()


def test_what_was_tested_once_is_drawn_as_dots_beside_scores_in_the_table(training, tmp_path):
    changed = {"collection.num_iterations": 1, "collection.episode_length": 200}
    done = compare(tmp_path, seeds=THREE, **changed)
    drawn = (tmp_path / "fig13-smoke/fig13.svg").read_text()
    rows = table(done, "pendulum")[1:]
    assert "–" not in [cells[-1] for cells in rows]
    assert all(f"<!-- {text} -->" in drawn for text in ("tmcl", "mcl"))
    assert "<!-- MCL and T-MCL, pendulum -->" in drawn
