"""Run directories written by hand: what a quick Pendulum run leaves behind, in shape."""

import csv
import json

import fakes
import numpy as np
import pytest

from headway.lab import comparison

GROUPS = {"train": (0.5, 0.75, 1.0, 1.25), "low": (0.25, 0.375), "high": (1.5, 1.75)}
LEVELS = {"train": -190.0, "low": -620.0, "high": -330.0}


def write_csv(path, columns, rows):
    with path.open("w", newline="") as file:
        csv.writer(file).writerows([columns.split(), *rows])


def summary(values):
    values = np.asarray(values)
    mean, std = float(values.mean()), float(values.std())
    return {"returns": values.tolist(), "return_mean": mean, "return_std": std}


def write(path, *, method="tmcl", seed=0, lift=0.0, env="pendulum", iterations=5, heads=3,
          every=1, **settings):  # fmt: skip
    """Write the tables of a run; `lift` is added to the returns of its tests.

    The tests of an iteration are the same for every method, but for the lift.
    """
    path.mkdir(parents=True)
    config = {
        "env": env, "method": method, "preset": "quick", "seed": seed, "env_options": {},
        "collection": {"num_iterations": iterations, "episode_length": 200}, **settings,
    }  # fmt: skip
    (path / "config.json").write_text(json.dumps({"config": config, "device": "cpu"}))
    rng = np.random.default_rng(seed)
    tests, lines = [], []
    for i in range(iterations):
        evaluated = {}
        if (i + 1) % every == 0:
            for group, lengths in GROUPS.items():
                values = rng.normal(LEVELS[group], 100, 8) + lift
                evaluated[group] = summary(values)
                tests += [
                    (method, env, seed, i, group, f"length={lengths[k % len(lengths)]:g} mass=1",
                     k, value, 200)
                    for k, value in enumerate(values)
                ]  # fmt: skip
        collected = summary(rng.normal(-1000 * np.exp(-i) - 180, 120, 5))
        seconds = {"collect": 60.0, "fit": 30.0, "evaluate": 6.0}
        lines.append(
            {"iteration": i, "timesteps": 1000 * (i + 1), "collection": collected,
             "fitting": {"loss": 1.0}, "evaluation": evaluated, "seconds": seconds}
        )  # fmt: skip
    (path / "metrics.jsonl").write_text("".join(json.dumps(line) + "\n" for line in lines))
    columns = "method env seed iteration group sim_params episode return length"
    write_csv(path / "evaluation.csv", columns, tests)
    shares = rng.dirichlet(np.ones(heads), (5, 4))
    write_csv(path / "assignments.csv", "iteration member head sim_params share", [
        (iterations - 1, member, head, f"length={length:g} mass=1", shares[member, k, head])
        for member in range(5)
        for head in range(heads)
        for k, length in enumerate(GROUPS["train"])
    ])  # fmt: skip
    write_csv(path / "prediction_error.csv", "iteration group step error", [
        (iterations - 1, group, step, scale * step / 10)
        for group, scale in (("train", 0.3), ("low", 0.9), ("high", 0.6))
        for step in range(1, 21)
    ])  # fmt: skip
    return path


@pytest.fixture(scope="session")
def write_run():
    return write


@pytest.fixture
def run_dir(tmp_path):
    return write(tmp_path / "run")


@pytest.fixture
def folder(tmp_path):
    """Two methods on Pendulum over three seeds, with both references."""
    lifts = {"tmcl": 0.0, "pets": -150.0, "random": -900.0, "true-dynamics": 300.0}
    for method, lift in lifts.items():
        for seed in range(3):
            write(tmp_path / f"runs/{method}-{seed}", method=method, seed=seed, lift=lift)
    return tmp_path / "runs"


@pytest.fixture
def training(monkeypatch):
    """Training that takes no time."""
    fake = fakes.FakeTraining()
    monkeypatch.setattr(comparison, "run_jobs", fake)
    return fake


@pytest.fixture
def without_figures(monkeypatch):
    """Figures take long to draw."""
    monkeypatch.setattr(comparison, "draw", lambda found: [])
