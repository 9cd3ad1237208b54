"""Tiny runs: trained, compared, or written by hand."""

import json

from headway.training.methods import make_config
from headway.training.progress import Progress
from headway.training.run import RunDir

TINY = {
    "collection.episode_length": 12,
    "collection.num_iterations": 3,
    "fitting.epochs": 3,
    "model.hidden_sizes": (8, 8),
    "model.context_hidden_sizes": (8,),
    "planner.num_candidates": 8,
    "planner.horizon": 3,
}


def tiny_config(env="pendulum", method="tmcl", seed=0, **changes):
    settings = {**TINY, **changes}
    return make_config(env, method=method, preset="smoke", seed=seed, settings=settings)


def random_config(seed=0, **settings):
    """A run that learns nothing, so that nothing is compiled."""
    return make_config("pendulum", method="random", preset="smoke", seed=seed, settings=settings)


class Listening(Progress):
    """Remembers what was said."""

    def __init__(self):
        self.said = []

    def message(self, text):
        self.said.append(text)


def result(path):
    """Everything that a run leaves behind, apart from times and what depends on them."""
    RunDir(path).check()
    files = [file for file in sorted(path.rglob("*")) if file.is_file() and file.name != ".lock"]
    contents = {str(file.relative_to(path)): file.read_bytes() for file in files}
    lines = contents.pop("metrics.jsonl").splitlines()
    untimed = [{**json.loads(line), "seconds": None} for line in lines]
    kept = {
        name: None if name.startswith("checksums") else content
        for name, content in contents.items()
        if not name.startswith(("figures", "config.json"))
    }
    return untimed, kept
