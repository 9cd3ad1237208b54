"""Runs that are small, or that are written instead of trained."""

import itertools
import json

import numpy as np

import runs
from headway.config import to_dict
from headway.errors import DivergenceError
from headway.lab.paper import experiment
from headway.lab.sweep import Comparison, Job
from headway.task import sim_param_sets
from headway.training.files import write_json
from headway.training.methods import METHODS, make_config
from headway.training.run import SCHEMA, EpisodeRow, RunDir, format_sim_params

LEVELS = {"train": -190.0, "low": -620.0, "high": -330.0, "collected": -300.0}
LIFTS = {"tmcl": 0.0, "pets": -150.0, "random": -900.0, "true-dynamics": 300.0}
DIVERGED = DivergenceError("no finite number")


def random_job(out, seed=0, **settings):
    return Job.of(runs.random_config(seed, **settings), out)


def comparison(out, name="fig13", envs=("pendulum",), seeds=(0,), preset="smoke", **settings):
    asked = experiment(name) if isinstance(name, str) else name
    return Comparison(asked, envs, seeds, preset, out, settings)


class FakeTraining:
    """Takes the place of `run_jobs`: writes returns that follow from method and seed."""

    def __init__(self):
        self.calls = []
        self.answers = {}  # errors, by seed, one per run

    def __call__(self, jobs, workers, *, quiet=True):
        failures = {}
        for job in (job for job in jobs if job.state.name != "done"):
            self.calls.append((job.config.method, job.config.seed))
            if errors := self.answers.get(job.config.seed):
                failures[job.path] = str(errors.pop(0))
            else:
                write_level(job.path, job.config)
        return failures


def level(config, iteration):
    """The mean return that a fake run reaches."""
    return 10.0 * len(config.method) + config.seed + iteration


def write_level(path, config):
    """Write a run with two episodes per group, on training physics with returns 100 higher."""

    def returns(iteration, group):
        mean = level(config, iteration) + 100.0 * (group == "train")
        return np.array([mean - 1, mean + 1])

    return write_run(path, config, returns)


def write(path, method="tmcl", *, seed=0, lift=0.0, env=None, iterations=5, heads=3, **settings):
    """Write a quick run on Pendulum, perhaps under a name that is nobody's.

    Its returns are the same for every method, but for the lift.
    """

    def returns(iteration, group):
        rng = np.random.default_rng([seed, iteration, len(group)])
        return rng.normal(LEVELS[group], 100, 8) + lift * (group != "collected")

    config = make_config(
        "pendulum",
        method=method if method in METHODS else "tmcl",
        preset="quick",
        seed=seed,
        settings={"collection.num_iterations": iterations, **settings},
    )
    write_run(path, config, returns, heads)
    content = json.loads((path / "config.json").read_bytes())
    content["config"] |= {"env": env or "pendulum", "method": method}
    write_json(path / "config.json", content)
    return path


def write_run(path, config, returns, heads=3):
    """Write what a run leaves behind, with returns by iteration and group."""
    write_json(path / "config.json", {"schema": SCHEMA, "config": to_dict(config), "device": "cpu"})
    sets, rng = sim_param_sets(config), np.random.default_rng(config.seed)
    train = [format_sim_params(physics) for physics in sets.group("train")]
    for i in range(config.collection.num_iterations):
        tested = {group: returns(i, group) for group in sets.group_names}
        run = config.method, config.env, config.seed, i
        shares = rng.dirichlet(np.ones(heads), (5, len(train)))
        tables = {
            "evaluation.csv": [
                EpisodeRow(*run, group, physics, episode, value, 200).to_csv()
                for group, values in tested.items()
                for episode, (value, physics) in enumerate(
                    zip(values, itertools.cycle(sets.group(group)), strict=False)
                )
            ],
            "assignments.csv": [
                {"iteration": i, "member": m, "head": h, "sim_params": train[k], "share": share}
                for (m, k, h), share in np.ndenumerate(shares)
            ],
            "prediction_error.csv": [
                {"iteration": i, "group": group, "step": step, "error": scale * step / 10}
                for group, scale in zip(tested, (0.3, 0.9, 0.6), strict=True)
                for step in range(1, 21)
            ],
        }
        metrics = {
            "iteration": i,
            "timesteps": 1000 * (i + 1),
            "collection": _summary(returns(i, "collected")),
            "evaluation": {group: _summary(values) for group, values in tested.items()},
            "seconds": {"collect": 60.0, "fit": 30.0, "evaluate": 6.0},
        }
        RunDir(path).save_iteration(metrics, (), [], {}, tables)
    return path


def _summary(returns):
    mean, std = float(returns.mean()), float(returns.std())
    return {"returns": returns.tolist(), "return_mean": mean, "return_std": std}
