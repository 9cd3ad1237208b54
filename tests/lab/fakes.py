"""Runs that are small, or that are written instead of trained."""

import numpy as np

import runs
from headway.errors import DivergenceError
from headway.lab.sweep import Job
from headway.task import sim_param_sets
from headway.training.methods import make_config
from headway.training.run import EpisodeRow

TINY = {
    "collection.episode_length": 6,
    "collection.num_iterations": 2,
    "fitting.epochs": 1,
    "model.hidden_sizes": [8, 8],
    "model.context_hidden_sizes": [8],
    "planner.num_candidates": 8,
    "planner.horizon": 3,
}
DIVERGED = DivergenceError("no finite number")


def tiny_job(out, seed=0, **changes):
    config = make_config("pendulum", preset="smoke", seed=seed, settings={**TINY, **changes})
    return Job.of(config, out)


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
                write_run(job.config, job.path)
        return failures


def level(config, iteration):
    """The mean return that a fake run reaches."""
    return 10.0 * len(config.method) + config.seed + iteration


def write_run(config, path, keep=None):
    """Write the files that reports read; with the tests of all iterations, or of one."""
    sets = sim_param_sets(config)
    lines, rows = [], []
    for i in range(config.collection.num_iterations):
        returns = [level(config, i) - 1, level(config, i) + 1]
        metrics = {
            "iteration": i,
            "timesteps": 20 * (i + 1),
            "collection": {
                "returns": returns, "return_mean": float(np.mean(returns)), "return_std": 1.0
            },
            "fitting": {"loss": 1.0},
            "evaluation": {},
            "seconds": {"collect": 1.0, "fit": 2.0, "evaluate": 1.0},
        }  # fmt: skip
        lines.append(metrics)
        for group in sets.group_names:
            shift = 100.0 if group == "train" else 0.0
            rows += [
                EpisodeRow(
                    config.method, config.env, config.seed, i, group,
                    dict(sets.group(group)[0]), episode, value + shift, 20,
                )
                for episode, value in enumerate(returns)
            ]  # fmt: skip
    kept = [row.to_csv() for row in rows if keep is None or row.iteration == keep]
    runs.write_run(path, config, lines, {"evaluation.csv": kept})
