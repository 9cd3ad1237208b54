"""Runs that are written instead of trained, and a board that remembers what it was told."""

import numpy as np

import runs
from headway.errors import BusyError, DivergenceError
from headway.sweeps.board import Board
from headway.sweeps.jobs import Job
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


def tiny_job(out, seed=0, **changes):
    config = make_config("pendulum", preset="smoke", seed=seed, settings={**TINY, **changes})
    return Job.of(config, out)


class Remembering(Board):
    """Keeps every status in the order of its arrival."""

    def __init__(self):
        super().__init__()
        self.told = []
        self.messages = []

    def show(self, job, before, status):
        self.told.append((job.path, status))

    def message(self, text):
        self.messages.append(text)

    def states(self, job):
        return [status.state for path, status in self.told if path == job.path]


class FakeTraining:
    """Takes the place of `train_run`: writes returns that follow from method and seed."""

    def __init__(self):
        self.calls = []
        self.answers = {}  # errors to raise, by seed, one per call

    def __call__(self, config, path, progress):
        self.calls.append((config.method, config.seed))
        errors = self.answers.get(config.seed)
        if errors:
            raise errors.pop(0)
        write_run(config, path, progress)


def level(config, iteration):
    """The mean return that a fake run reaches."""
    return 10.0 * len(config.method) + config.seed + iteration


def write_run(config, path, progress=None, keep=None):
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
        if progress:
            progress.iteration_done(metrics)
    kept = [row.to_csv() for row in rows if keep is None or row.iteration == keep]
    runs.write_run(path, config, lines, {"evaluation.csv": kept})


BUSY = BusyError("held by another process")
DIVERGED = DivergenceError("no finite number")
