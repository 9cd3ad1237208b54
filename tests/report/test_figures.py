import io
import json

import matplotlib
import numpy as np
import pytest
from PIL import Image
from rich.console import Console

import runs
from headway.errors import RunError
from headway.experiment.methods import make_config
from headway.report.dynamics import Changes, choose_views, collect_changes
from headway.report.figures import _tested, save_run_figures
from headway.report.obs_names import obs_names
from headway.report.physics import axis_label, distinct, full_label, varying
from headway.report.tables import by_group, by_physics, envs, evaluation
from headway.task import env_spec
from headway.training.run import EpisodeRow

ALL = ["learning_curve.png", "evaluation.png", "head_shares.png", "prediction_error.png"]


def test_every_figure_is_drawn(run_dir):
    paths = save_run_figures(run_dir)
    assert [path.name for path in paths] == ALL
    for path in paths:
        assert path.parent == run_dir / "figures"
        pixels = np.asarray(Image.open(path).convert("L"))
        assert pixels.shape[0] > 400
        assert 0.005 < (pixels < 200).mean() < 0.6
    assert sorted(p.name for p in (run_dir / "figures").iterdir()) == sorted(ALL)


def test_settings_of_the_user_stay_as_they_are(run_dir):
    before = dict(matplotlib.rcParams)
    save_run_figures(run_dir)
    assert dict(matplotlib.rcParams) == before


@pytest.mark.parametrize(
    ("missing", "figure"),
    [
        ("evaluation.csv", "evaluation.png"),
        ("assignments.csv", "head_shares.png"),
        ("prediction_error.csv", "prediction_error.png"),
    ],
)
def test_a_missing_file_leaves_its_figure_out(run_dir, missing, figure):
    (run_dir / missing).unlink()
    names = [path.name for path in save_run_figures(run_dir)]
    assert names == [name for name in ALL if name != figure]


def test_a_run_without_a_finished_iteration_has_no_figures(run_dir):
    (run_dir / "metrics.jsonl").write_text("")
    runs.accept_changes(run_dir)
    assert save_run_figures(run_dir) == []


def test_a_run_of_one_iteration_with_many_members(tmp_path, write_run):
    path = write_run(tmp_path / "run", iterations=1, evaluated=(0,), members=7, heads=8)
    assert [figure.name for figure in save_run_figures(path)] == ALL


def test_diverged_predictions_are_drawn_on_a_log_scale(run_dir):
    table = run_dir / "prediction_error.csv"
    table.write_text(table.read_text() + "4,low,21,1e6\n4,low,22,nan\n")
    runs.accept_changes(run_dir)
    assert len(save_run_figures(run_dir)) == 4


def test_no_figures_of_what_is_no_run(tmp_path):
    with pytest.raises(RunError, match="not a directory"):
        save_run_figures(tmp_path / "nothing")


def test_an_unseen_training_group_is_optional_in_the_metrics(run_dir):
    rows = [json.loads(line) for line in (run_dir / "metrics.jsonl").read_text().splitlines()]
    for row in rows:
        row.pop("evaluation")
    (run_dir / "metrics.jsonl").write_text("\n".join(map(json.dumps, rows)))
    runs.accept_changes(run_dir)
    assert save_run_figures(run_dir)[0].name == "learning_curve.png"


def test_the_last_tests_are_found_in_one_go():
    class Counting(EpisodeRow):
        reads = 0

        def __getattribute__(self, name):
            Counting.reads += name == "iteration"
            return super().__getattribute__(name)

    physics = {"length": 0.5, "mass": 1.0}
    rows = [
        Counting("tmcl", "pendulum", 0, i // 10, "train", physics, i, -126.0, 200)
        for i in range(100)
    ]
    Counting.reads = 0
    assert _tested(rows) == "10 test episodes per group"
    assert Counting.reads <= 3 * len(rows)


def test_physics_are_written_for_readers():
    physics = [{"length": 1.5, "mass": 1.0}, {"length": 0.5, "mass": 1.0}]
    assert distinct(physics)[0]["length"] == 0.5
    assert varying(physics) == ["length"]
    assert varying(physics[:1]) == ["length", "mass"]
    assert axis_label(["length", "mass_scale"]) == "length (m), mass scale"
    assert full_label(physics[0], ["length"]) == "length 1.5 m"


def test_a_group_score_counts_each_physics_once():
    def row(length, value):
        physics = {"length": length, "mass": 1.0}
        return EpisodeRow("tmcl", "pendulum", 0, 0, "train", physics, 0, value, 200)

    config = make_config("pendulum")
    rows = [row(0.5, -126.0), row(1.0, -1143.0), row(1.0, -1143.0)]
    assert [part["episodes"] for part in by_physics(rows, config)] == [1, 2]
    (group,) = by_group(rows, config)
    assert group["score"] == pytest.approx(0.5)
    assert (group["episodes"], group["return_mean"]) == (3, (-126 - 1143) / 2)
    assert group["return_std"] == pytest.approx((1143 - 126) / 2)
    rows.append(row(9.0, 0.0))
    assert by_group(rows, config)[0]["score"] is None


def test_brackets_in_names_are_no_markup():
    physics = {"length": 0.5, "mass": 1.0}
    rows = [EpisodeRow("tmcl", "pendulum", 0, 0, "[/x]", physics, 0, -126.0, 200)]
    table = evaluation(rows, make_config("pendulum"), "runs/[/x][bold]")
    console = Console(width=120, file=io.StringIO(), record=True)
    console.print(table)
    text = console.export_text()
    assert "runs/[/x][bold]" in text
    assert "unseen: [/x]" in text


def test_scores_are_of_the_protocol_not_of_the_episodes_that_survived():
    def row(value, steps):
        physics = {"mass_scale": 0.1}
        return EpisodeRow("tmcl", "cartpole-swingup", 0, 0, "low", physics, 0, value, steps)

    rows = [row(480.0, 500), *[row(20.0, 60)] * 9]
    whole = make_config("cartpole-swingup")
    assert by_physics(rows, whole)[0]["score"] == pytest.approx((66 - 215) / (489 - 215))
    assert by_physics([row(80.0, 200)], whole)[0]["score"] == pytest.approx(-135 / 274)
    options = {"env_options": {"terminate_off_track": True}}
    ending = make_config("cartpole-swingup", settings=options)
    assert by_physics(rows, ending)[0]["score"] is None  # nothing was measured for it
    assert by_group(rows, ending)[0]["score"] is None


def test_the_views_are_the_numbers_that_tell_physics_apart():
    rng = np.random.default_rng(0)
    varied = np.repeat(rng.normal(size=(1, 50, 4)), 3, axis=0)
    varied[..., 2] *= np.array([1.0, 2.0, 4.0])[:, None]
    varied[..., 3] = 2 * varied[..., 2]
    varied[..., 1] = 0.0
    views = choose_views(Changes([], varied, varied[0]), ["a", "b", "c", "d"])
    assert [view.label for view in views] == [f"change of {name} in one step" for name in "ca"]
    assert views[0](varied).shape == (3, 50)


def test_only_the_physics_differ_between_the_changes():
    spec = env_spec("pendulum")
    changes = collect_changes(spec, 6, seed=0)
    assert changes.varied.shape == (4, 6, 3)
    default = changes.physics.index(dict(spec.default_sim_params))
    np.testing.assert_allclose(changes.varied[default], changes.default, atol=1e-6)
    velocity = changes.varied[..., 2]
    assert (np.ptp(velocity, axis=0) > 0).all()


def test_names_of_observations_fit_the_environments():
    entries, _ = envs()
    for entry in entries:
        names = obs_names(entry["name"], entry["obs_size"])
        assert len(set(names)) == entry["obs_size"]
        assert not names[0].startswith("observation"), entry["name"]
    assert len(obs_names("hopper", 11)) == 11
    assert obs_names("pendulum", 4)[0] == "observation[0]"
