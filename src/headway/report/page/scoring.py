"""Scores: returns between those of random actions and of the planner on the true dynamics."""

import dataclasses
from collections.abc import Iterable, Mapping, Sequence

import numpy as np

from headway.config import Config
from headway.experiment.references import mean_score, normalised, score_of
from headway.report.page.runs import LoadedRun
from headway.storage.tables import EpisodeRow, format_sim_params
from headway.tasks.catalog import env_names, env_options, episode_length

RANDOM = "random"
CEILING = "true-dynamics"
REFERENCES = (RANDOM, CEILING)

_Place = tuple[str, str, int, str]  # environment, physics, steps of an episode, options


@dataclasses.dataclass(frozen=True)
class Outcome:
    """How one run did on one group after its last iteration."""

    episode_return: float
    """Mean over the group's physics, each counting once."""
    score: float | None
    """The same of scores; None unless references are known for all of them."""


@dataclasses.dataclass(frozen=True)
class References:
    """Mean returns of `random` and `true-dynamics` for each physics."""

    returns: Mapping[tuple[str, _Place], float]
    """By method and place."""

    @classmethod
    def of(cls, runs: Sequence[LoadedRun]) -> "References":
        """Take the references among runs; every seed of a place counts once."""
        found: dict[tuple[str, _Place], list[float]] = {}
        for run in runs:
            if run.config.method in REFERENCES:
                for place, value in _by_place(run.tests, run.config).items():
                    found.setdefault((run.config.method, place), []).append(value)
        return cls({place: float(np.mean(values)) for place, values in found.items()})

    def score(self, row: EpisodeRow, config: Config) -> float | None:
        """Score of one test episode of a run; None where no reference is known.

        References among the runs come first, then the project's own table.
        """
        random, ceiling = (self.returns.get((name, _place(row, config))) for name in REFERENCES)
        if random is None or ceiling is None or random == ceiling:
            return score_of(row, config)
        return normalised(row.episode_return, random, ceiling)

    def level(self, method: str, runs: Sequence[LoadedRun], group: str) -> float | None:
        """Mean return of a reference over the physics of a group; None if one lacks."""
        tests = [(row, run.config) for run in runs for row in run.tests if row.group == group]
        places = {_place(row, config) for row, config in tests}
        return mean_score([self.returns.get((method, place)) for place in places])

    def describe(self, env: str) -> str:
        """Say where the references of an environment come from."""
        methods = {method for method, place in self.returns if place[0] == env}
        if methods == set(REFERENCES):
            return "normalised by the runs of random and true-dynamics given here"
        return "normalised by the project's reference returns"


def outcome(rows: Sequence[EpisodeRow], references: References, config: Config) -> Outcome:
    """Summarise one run's test episodes of one group."""
    parts = by_physics(rows).values()
    returns = [np.mean([row.episode_return for row in same]) for same in parts]
    scores = [mean_score([references.score(row, config) for row in same]) for same in parts]
    return Outcome(float(np.mean(returns)), mean_score(scores))


def by_physics(rows: Sequence[EpisodeRow]) -> dict[str, list[EpisodeRow]]:
    """Episodes by their simulator parameters."""
    found: dict[str, list[EpisodeRow]] = {}
    for row in rows:
        found.setdefault(format_sim_params(row.sim_params), []).append(row)
    return found


def _by_place(rows: Iterable[EpisodeRow], config: Config) -> dict[_Place, float]:
    found: dict[_Place, list[float]] = {}
    for row in rows:
        found.setdefault(_place(row, config), []).append(row.episode_return)
    return {place: float(np.mean(values)) for place, values in found.items()}


def _place(row: EpisodeRow, config: Config) -> _Place:
    physics, known = format_sim_params(row.sim_params), config.env in env_names()
    length = episode_length(config) if known else config.collection.episode_length
    options = env_options(config) if known else config.env_options
    return config.env, physics, length or 0, repr(sorted(options.items()))
