"""A run directory written by hand: what a quick Pendulum run leaves behind, in shape."""

import numpy as np
import pytest

import runs
from headway import config as settings
from headway.config import CollectionConfig, Config
from headway.training.run import EpisodeRow

TRAIN = (0.5, 0.75, 1.0, 1.25)
GROUPS = {"train": TRAIN, "low": (0.25, 0.375), "high": (1.5, 1.75)}
LEVELS = {"train": -190.0, "low": -620.0, "high": -330.0}


def physics(length):
    return {"length": length, "mass": 1.0}


def summary(returns):
    values = np.asarray(returns)
    return {
        "returns": values.tolist(),
        "return_mean": float(values.mean()),
        "return_std": float(values.std()),
        "return_min": float(values.min()),
        "return_max": float(values.max()),
        "episodes": len(values),
    }


def metrics_rows(rng, iterations, evaluated):
    for i in range(iterations):
        level = -1300.0 if i == 0 else -1000.0 * np.exp(-i) - 180
        tested = {group: summary(rng.normal(LEVELS[group], 90, 8)) for group in GROUPS}
        yield {
            "iteration": i,
            "timesteps": 1000 * (i + 1),
            "collection": {**summary(rng.normal(level, 120, 5)), "planner_failures": 0},
            "fitting": {"loss": 1.0, "updates": 10, "skipped_updates": 0, "transitions": 5},
            "evaluation": tested if i in evaluated else {},
            "seconds": {"collect": 1.0, "fit": 1.0, "evaluate": 1.0},
        }


def assignment_rows(rng, iterations, members, heads):
    for i in range(iterations):
        for member in range(members):
            for length in TRAIN:
                owner = rng.permutation(heads)[TRAIN.index(length) % heads]
                shares = rng.dirichlet(np.where(np.arange(heads) == owner, 12.0, 0.6))
                for head, share in enumerate(shares):
                    yield {
                        "iteration": i,
                        "member": member,
                        "head": head,
                        "sim_params": f"length={length:g} mass=1",
                        "share": share,
                    }


def write(
    path,
    *,
    iterations=5,
    evaluated=(4,),
    env="pendulum",
    members=5,
    heads=3,
    method="tmcl",
    seed=0,
    lift=0.0,
    settings_changed=None,
):
    """Write every file that the figures read; `lift` is added to the returns of the tests."""
    rng = np.random.default_rng(seed)
    config = Config(
        env=env,
        method=method,
        seed=seed,
        preset="quick",
        collection=CollectionConfig(num_iterations=iterations, num_episodes=5),
    )
    config = settings.override(config, settings_changed or {})
    metrics = list(metrics_rows(rng, iterations, evaluated))
    rows = [
        EpisodeRow(
            method, env, seed, i, group, physics(lengths[k % len(lengths)]), k, float(value), 200
        )
        for i in evaluated
        for group, lengths in GROUPS.items()
        for k, value in enumerate(rng.normal(LEVELS[group] + lift, 150, 8))
    ]
    assignments = list(assignment_rows(rng, iterations, members, heads))
    errors = [
        {
            "iteration": i,
            "group": group,
            "step": step,
            "error": scale * (1 - np.exp(-step / 8)),
        }
        for i in evaluated
        for group, scale in (("train", 0.35), ("low", 0.9), ("high", 0.6))
        for step in range(1, 21)
    ]
    tables = {
        "evaluation.csv": [row.to_csv() for row in rows],
        "assignments.csv": assignments,
        "prediction_error.csv": errors,
    }
    return runs.write_run(path, config, metrics, tables)


@pytest.fixture(scope="session")
def write_run():
    return write


@pytest.fixture
def run_dir(tmp_path, write_run):
    return write_run(tmp_path / "run")
