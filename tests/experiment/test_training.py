"""The whole loop, at smoke size: every environment, repeatability, resuming, early endings."""

import json
from pathlib import Path

import numpy as np
import pytest

import headway
from headway.errors import PlanningError, RunError, UnknownNameError
from headway.experiment import loading, training
from headway.experiment.methods import make_config
from headway.storage import arrays
from headway.storage.run_dir import RunDir
from headway.task import env_names

TINY = {"collection.episode_length": 12, "fitting.epochs": 1}


def untimed(run_dir: Path) -> list[dict]:
    lines = (run_dir / "metrics.jsonl").read_text().splitlines()
    return [{k: v for k, v in json.loads(line).items() if k != "seconds"} for line in lines]


def contents(run_dir: Path) -> dict[str, bytes]:
    """Everything a run wrote, apart from times, and manifests, which hold checksums of times."""
    return {
        str(path.relative_to(run_dir)): path.read_bytes()
        for path in sorted(run_dir.rglob("*"))
        if path.is_file()
        and path.name != "metrics.jsonl"
        and not {"tensorboard", "figures", "manifests"} & set(path.parts)
    }


@pytest.fixture(scope="module")
def reference(tmp_path_factory) -> Path:
    """An uninterrupted pendulum run."""
    path = tmp_path_factory.mktemp("runs") / "reference"
    training.train_run(make_config("pendulum", preset="smoke", settings=TINY), path)
    return path


def marked(env: str):
    """Other methods run on these by default (`test_every_pair`, `test_adaptive_methods`)."""
    return pytest.param(env, marks=pytest.mark.slow if env in ("hopper", "slim-humanoid") else ())


@pytest.mark.parametrize("env", [marked(env) for env in env_names()])
def test_smoke_run_and_evaluation_of_every_unseen_group(env, tmp_path):
    run = headway.train(env, preset="smoke", seed=1, run_dir=tmp_path / env)
    assert [m["iteration"] for m in run.metrics] == [0, 1]
    assert np.isfinite([m["fitting"]["loss"] for m in run.metrics]).all()
    assert all(path.exists() for path in run.figures)
    assert len(run.figures) == 4
    spec = headway.env_spec(env)
    for group in spec.sim_params.unseen:
        rows = headway.evaluate(run.path, groups=[group], num_episodes=2)
        assert [row.group for row in rows] == [group] * 2
        assert all(dict(row.sim_params) in spec.sim_params.group(group) for row in rows)
        assert np.isfinite([row.episode_return for row in rows]).all()


def test_groups_are_tested_when_the_settings_say(tmp_path):
    run = headway.train(
        "pendulum", method="vanilla", preset="smoke", run_dir=tmp_path, settings=TINY
    )
    assert len(run.evaluation) == 2 * 2 + 3 * 2  # low and high twice, training physics at the end


def test_same_seed_gives_identical_files(reference, tmp_path):
    training.train_run(make_config("pendulum", preset="smoke", settings=TINY), tmp_path / "again")
    assert untimed(tmp_path / "again") == untimed(reference)
    assert contents(tmp_path / "again") == contents(reference)


def test_other_seed_gives_other_metrics(reference, tmp_path):
    config = make_config("pendulum", preset="smoke", seed=7, settings=TINY)
    training.train_run(config, tmp_path / "other")
    assert untimed(tmp_path / "other") != untimed(reference)


def interrupt(config, path, broken, monkeypatch):
    """Train until a part of the second iteration, which is interrupted."""
    whole = getattr(training.Trainer, broken)

    def fail_in_second_iteration(self, iteration, *args):
        if iteration == 1:
            raise KeyboardInterrupt
        return whole(self, iteration, *args)

    with monkeypatch.context() as patch:
        patch.setattr(training.Trainer, broken, fail_in_second_iteration)
        with pytest.raises(KeyboardInterrupt):
            training.train_run(config, path)
    assert RunDir(path).finished_iterations == 1


@pytest.mark.parametrize("broken", ["fit", "evaluate", "save"])
def test_interrupted_run_resumes_to_the_same_end(broken, reference, tmp_path, monkeypatch):
    config = make_config("pendulum", preset="smoke", settings=TINY)
    interrupt(config, tmp_path / "cut", broken, monkeypatch)
    training.train_run(config, tmp_path / "cut")
    assert untimed(tmp_path / "cut") == untimed(reference)
    assert contents(tmp_path / "cut") == contents(reference)


def test_finished_run_is_left_alone(reference):
    before = contents(reference)
    training.train_run(make_config("pendulum", preset="smoke", settings=TINY), reference)
    assert contents(reference) == before


def test_other_settings_in_the_same_directory_are_refused_with_the_difference(reference):
    config = make_config("pendulum", preset="smoke", settings={**TINY, "planner.horizon": 5})
    with pytest.raises(RunError, match=r"planner\.horizon: 4 -> 5"):
        training.train_run(config, reference)


def test_environments_are_closed_where_nothing_comes_of_a_run(reference, monkeypatch):
    """They may be processes, which would stay for as long as somebody keeps the error."""
    made, closed = [], []
    make, close = training.Arena.make, training.Arena.close
    monkeypatch.setattr(
        training.Arena, "make", lambda config: made.append(make(config)) or made[-1]
    )
    monkeypatch.setattr(training.Arena, "close", lambda arena: closed.append(arena) or close(arena))
    with pytest.raises(RunError):
        training.train_run(make_config("pendulum", preset="smoke", seed=1), reference)
    with pytest.raises(UnknownNameError):
        headway.evaluate(reference, groups=["highest"])
    training.train_run(make_config("pendulum", preset="smoke", settings=TINY), reference)
    assert len(made) == len(closed) == 3


def test_directory_that_is_no_run_is_refused(tmp_path):
    (tmp_path / "thesis.txt").write_text("mine")
    with pytest.raises(RunError, match="holds no run"):
        training.train_run(make_config("pendulum", preset="smoke"), tmp_path)
    assert [path.name for path in tmp_path.iterdir()] == ["thesis.txt"]


def test_episodes_that_end_early_are_learned_from(tmp_path):
    settings = {
        "env_options": {"terminate_off_track": True},
        "collection.episode_length": 250,
        "collection.num_episodes": 3,
        "evaluation.num_episodes": 3,
    }
    config = make_config("cartpole-swingup", preset="smoke", seed=3, settings=settings)
    run = training.train_run(config, tmp_path / "run")
    trajectories = run.load_data()
    lengths = [len(trajectory) for trajectory in trajectories]
    assert min(lengths) < 250
    for trajectory in trajectories:
        assert trajectory.terminated == (abs(trajectory.obs[-1, 0]) > np.float32(2.4))
        assert trajectory.terminated or len(trajectory) == 250
    assert {row.length for row in run.evaluation()} - {250}
    assert run.metrics()[-1]["fitting"]["transitions"] == sum(lengths)


@pytest.mark.parametrize(
    ("settings", "evaluations"),
    [
        ({}, 2 * 16),
        ({"planner.num_candidates": 8}, 2 * 8),
        ({"planner.optimizer": "icem"}, 16 + 12 + 2 * 1 + 1),
        ({"planner.optimizer": "mppi", "planner.num_iterations": 3}, 3 * 16),
    ],
)
def test_a_run_can_be_tested_with_another_planner(settings, evaluations, reference):
    before = contents(reference)
    found = headway.evaluate(reference, groups=["low"], num_episodes=3, settings=settings)
    assert [row.group for row in found] == ["low"] * 3
    assert len(found) == 3
    assert found.cost.evaluations_per_step == evaluations
    rows_per_step = evaluations * 2 * 4  # particles, horizon
    assert found.cost.flop_per_step == rows_per_step * 2 * (4 * 16 + 16 * 16 + 16 * 6)
    assert 0 < found.cost.seconds_per_step < 60
    assert contents(reference) == before


def test_what_training_has_fixed_cannot_be_changed_by_a_test(reference):
    with pytest.raises(
        headway.ConfigError, match=r"model\.num_heads is fixed by training, allowed:"
    ):
        headway.evaluate(reference, settings={"model.num_heads": 2})
    with pytest.raises(headway.ConfigError, match=r"Did you mean 'planner\.horizon'"):
        headway.evaluate(reference, settings={"planer.horizon": 2})
    with pytest.raises(headway.ConfigError, match=r"num_elites is 4, allowed: at most num_cand"):
        headway.evaluate(reference, settings={"planner.num_candidates": 3})


def test_controller_stays_in_bounds_and_names_its_heads(reference):
    controller = headway.load(reference)
    assert controller.heads is None
    rng = np.random.default_rng(0)
    for _ in range(5):
        action = controller.act(rng.uniform(-1, 1, 3))
        assert action.shape == (1,)
        assert np.abs(action) <= 2.0
    assert controller.heads.shape == (2,)
    assert set(controller.heads) <= {0, 1, 2}


def test_reset_makes_a_controller_forget(reference):
    obs = np.array([1.0, 0.0, 0.5])
    fresh, used = headway.load(reference), headway.load(reference)
    fresh.reset()
    for _ in range(3):
        used.act(obs)
    used.reset()
    assert np.array_equal(fresh.act(obs), used.act(obs))


@pytest.mark.parametrize(
    ("obs", "error", "says"),
    [
        (np.zeros(4), headway.ConfigError, r"\(4,\), allowed: \(3,\)"),
        (np.array([0, np.nan, 0]), PlanningError, r"obs\[1\] is nan"),
    ],
)
def test_bad_observation_is_refused(obs, error, says, reference):
    with pytest.raises(error, match=says):
        headway.load(reference).act(obs)


@pytest.mark.parametrize("keep", [0, 10, 1000, -1])
def test_damaged_checkpoint_is_named(keep, reference, tmp_path):
    checkpoint = RunDir(reference).checkpoint(1)
    damaged = tmp_path / "checkpoint.safetensors"
    damaged.write_bytes(checkpoint.read_bytes()[:keep])
    config = RunDir(reference).config()
    template = loading.initial(config, loading.load_task(config))
    with pytest.raises(RunError, match=r"checkpoint\.safetensors is damaged"):
        arrays.load_tree(damaged, template)


def test_checkpoint_of_another_model_is_refused(reference):
    config = make_config("pendulum", preset="smoke", settings={"model.hidden_sizes": (8, 8)})
    template = loading.initial(config, loading.load_task(config))
    with pytest.raises(RunError, match="belongs to another model"):
        arrays.load_tree(RunDir(reference).checkpoint(1), template)


def test_heads_of_a_run_share_every_segment(reference):
    run = RunDir(reference)
    rows = [row for row in run.assignments() if row["iteration"] == 1]
    totals: dict = {}
    for row in rows:
        place = row["member"], row["sim_params"]
        totals[place] = totals.get(place, 0.0) + row["share"]
    assert totals
    assert np.allclose(list(totals.values()), 1.0)
