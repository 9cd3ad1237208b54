"""The table of runs: numbers against hand-made ones, labels, scores, damage."""

import json
import shutil
import subprocess
import sys

import fakes
import numpy as np
import pandas as pd
import pytest

from headway.cli import Command
from headway.errors import RunError
from headway.lab import tables
from headway.lab.tables import read_runs
from headway.training.methods import make_config
from headway.training.run import EpisodeRow


def mean_of(path, length):
    """The mean return of one physics after the last iteration, by other means."""
    rows = pd.read_csv(path / "evaluation.csv").query("iteration == 4")
    return rows[rows.sim_params == f"length={length:g} mass=1"]["return"].mean()


def test_numbers_are_those_of_the_files(written):
    runs = read_runs([written])
    parts = tables.by_physics(runs.final).set_index(["label", "seed", "sim_params"])
    one = parts.loc[("pets", 1, "length=0.5 mass=1")]
    assert one.return_mean == pytest.approx(mean_of(written / "pets-1", 0.5))
    low, high = (
        np.mean([mean_of(written / f"{name}-{seed}", 0.5) for seed in range(3)])
        for name in ("random", "true-dynamics")
    )
    assert one.score == pytest.approx((one.return_mean - low) / (high - low))
    groups = tables.by_group(runs.final).set_index(["label", "seed", "group"])
    means = [mean_of(written / "pets-1", length) for length in (0.25, 0.375)]
    assert groups.loc[("pets", 1, "low")].return_mean == pytest.approx(np.mean(means))
    assert runs.runs.set_index("run").loc[str(written / "pets-1"), "collect"] == 5
    assert not runs.notes


def test_the_projects_references_serve_where_no_run_is_one(run_dir):
    parts = tables.by_physics(read_runs([run_dir]).final).set_index("sim_params")
    one = parts.loc["length=0.5 mass=1"]
    assert one.score == pytest.approx((one.return_mean + 1501) / (-126 + 1501))


def test_references_that_planned_in_several_ways_normalise_nothing(tmp_path):
    for horizon in (10, 30):
        path, planner = tmp_path / f"ceiling-{horizon}", {"planner.horizon": horizon}
        fakes.write(path, "true-dynamics", env="own", **planner)
    fakes.write(tmp_path / "random", "random", env="own", lift=-900)
    fakes.write(tmp_path / "tmcl", env="own")
    runs = read_runs([tmp_path])
    assert runs.episodes.score.isna().all()
    compared = runs.runs[~runs.runs.is_reference]
    assert list(compared.label) == [
        "tmcl", "true-dynamics, horizon 10", "true-dynamics, horizon 30"
    ]  # fmt: skip


def test_a_run_that_stands_twice_counts_once(run_dir, tmp_path):
    shutil.copytree(run_dir, tmp_path / "copy")
    runs = read_runs([run_dir, tmp_path, run_dir])
    assert len(runs.runs) == 1
    assert [text for _, text in runs.notes] == [
        f"left out: same settings and seed as {tmp_path / 'copy'}."
    ]


@pytest.mark.parametrize(
    ("name", "lost"),
    [
        ("config.json", "left out"),
        ("metrics.jsonl", "no curve, times or final result"),
        ("evaluation.csv", "no final result"),
        ("assignments.csv", "no head shares"),
        ("prediction_error.csv", "no prediction errors"),
    ],
)
@pytest.mark.parametrize("content", [b"\xff\x00 no\n", b"[1,2]\n", b'iteration,group\nx,"y\n'])
def test_damage_costs_one_line(folder, name, lost, content):
    (folder / "tmcl-1" / name).write_bytes(content)
    runs = read_runs([folder])
    own = [text for run, text in runs.notes if run == str(folder / "tmcl-1")]
    assert own[0].startswith(lost)
    assert all("\n" not in text for text in own)
    assert len(runs.runs) == 12 - (name == "config.json")


def test_unfinished_runs_have_curves_but_no_final_results(folder):
    path = folder / "tmcl-2/metrics.jsonl"
    path.write_text("".join(path.read_text().splitlines(keepends=True)[:3]))
    runs = read_runs([folder])
    assert runs.notes[0][1].startswith("3 of 5 iterations are finished")
    assert str(folder / "tmcl-2") not in set(runs.final["run"])
    assert str(folder / "tmcl-2") in set(runs.curves["run"])


def test_nothing_to_read_is_an_error(tmp_path):
    with pytest.raises(RunError, match="not a directory"):
        read_runs([tmp_path / "nothing"])
    with pytest.raises(RunError, match="holds no run"):
        read_runs([tmp_path])
    (tmp_path / "config.json").write_text("{")
    with pytest.raises(RunError, match="none of 1 runs can be read"):
        read_runs([tmp_path])


def test_settings_of_an_older_shape_are_read(run_dir):
    config = {"env": "pendulum", "method": "gone", "seed": 3}
    (run_dir / "config.json").write_text(json.dumps(config))
    runs = read_runs([run_dir])
    assert list(runs.runs.label) == ["gone"]
    assert len(runs.final) == 24


def test_settings_that_change_no_number_part_no_seeds(tmp_path):
    fakes.write(tmp_path / "plain")
    kept = {"collection.num_checkpoints": 5, "collection.step_timeout_s": 5.0}
    fakes.write(tmp_path / "kept", seed=1, **kept)
    fakes.write(tmp_path / "again", seed=1)
    runs = read_runs([tmp_path])
    assert {*runs.runs.label} == {"tmcl"}
    assert len(runs.runs) == 2
    assert "same settings and seed" in runs.notes[0][1]


def test_a_group_score_counts_each_physics_once():
    def row(length, value):
        physics = {"length": length, "mass": 1.0}
        return EpisodeRow("tmcl", "pendulum", 0, 0, "train", physics, 0, value, 200)

    config = make_config("pendulum")
    rows = [row(0.5, -126.0), row(1.0, -1143.0), row(1.0, -1143.0)]
    facts, _ = tables.evaluation(rows, config)
    assert [part["episodes"] for part in facts["physics"]] == [1, 2]
    (group,) = facts["groups"]
    assert group["score"] == pytest.approx(0.5)
    assert (group["episodes"], group["return_mean"]) == (3, (-126 - 1143) / 2)
    assert group["return_std"] == pytest.approx((1143 - 126) / 2)
    unknown, _ = tables.evaluation([*rows, row(9.0, 0.0)], config)
    assert unknown["groups"][0]["score"] is None


def test_brackets_in_names_are_no_markup(capsys):
    row = EpisodeRow("tmcl", "pendulum", 0, 0, "[/x]", {"length": 0.5, "mass": 1.0}, 0, -126.0, 200)
    Command().show({}, tables.evaluation([row], make_config("pendulum"), "runs/[/x][bold]")[1])
    out = capsys.readouterr().out
    assert "runs/[/x][bold]" in out
    assert "unseen: [/x]" in out


def test_physics_are_written_for_readers():
    physics = [{"length": 1.5, "mass": 1.0}, {"length": 0.5, "mass": 1.0}]
    assert tables.distinct(physics)[0]["length"] == 0.5
    assert tables.varying(physics) == ["length"]
    assert tables.varying(physics[:1]) == ["length", "mass"]
    assert tables.axis_label(["length", "mass_scale"]) == "length, mass scale"
    assert tables.full_label(physics[0], ["length"]) == "length 1.5"


def test_a_missing_extra_is_one_clear_line():
    code = (
        "import importlib.util as u; find = u.find_spec;"
        "u.find_spec = lambda name, *rest: None if name == 'pandas' else find(name, *rest);"
        "from headway.cli import main; raise SystemExit(main(['list', 'envs']))"
    )
    done = subprocess.run([sys.executable, "-c", code], check=False, capture_output=True, text=True)
    assert done.returncode == 1
    assert "pandas not installed" in done.stderr
    assert done.stderr.strip().endswith("pip install 'headway[lab]'.")
    assert done.stderr.count("\n") == 1
