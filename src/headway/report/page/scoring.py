"""Scores: returns between those of random actions and of the planner on the true dynamics."""

import dataclasses
from collections.abc import Iterable, Mapping, Sequence

import numpy as np

from headway.experiment.references import normalised, score
from headway.report.page.runs import LoadedRun
from headway.storage.tables import EpisodeRow, format_sim_params

RANDOM = "random"
CEILING = "true-dynamics"
REFERENCES = (RANDOM, CEILING)

_Place = tuple[str, str, int]  # environment, physics, steps of the episode


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
                for place, value in _by_place(run.tests).items():
                    found.setdefault((run.config.method, place), []).append(value)
        return cls({place: float(np.mean(values)) for place, values in found.items()})

    def score(self, row: EpisodeRow) -> float | None:
        """Score of one test episode; None where no reference is known.

        References among the runs come first, then the project's own table.
        """
        random, ceiling = (self.returns.get((name, _place(row))) for name in REFERENCES)
        if random is None or ceiling is None or random == ceiling:
            return score(row.env, row.sim_params, row.episode_return, row.length)
        return normalised(row.episode_return, random, ceiling)

    def level(self, method: str, rows: Iterable[EpisodeRow]) -> float | None:
        """Mean return of a reference over the places of some episodes; None if one lacks."""
        return _mean([self.returns.get((method, place)) for place in {_place(row) for row in rows}])

    def describe(self, env: str) -> str:
        """Say where the references of an environment come from."""
        methods = {method for method, place in self.returns if place[0] == env}
        if methods == set(REFERENCES):
            return "normalised by the runs of random and true-dynamics given here"
        return "normalised by the project's reference returns"


def outcome(rows: Sequence[EpisodeRow], references: References) -> Outcome:
    """Summarise one run's test episodes of one group."""
    parts = by_physics(rows).values()
    returns = [np.mean([row.episode_return for row in same]) for same in parts]
    scores = [_mean([references.score(row) for row in same]) for same in parts]
    return Outcome(float(np.mean(returns)), _mean(scores))


def _mean(values: Sequence[float | None]) -> float | None:
    """The mean, or None where one value is missing."""
    known = [value for value in values if value is not None]
    return float(np.mean(known)) if known and len(known) == len(values) else None


def by_physics(rows: Sequence[EpisodeRow]) -> dict[str, list[EpisodeRow]]:
    """Episodes by their simulator parameters."""
    found: dict[str, list[EpisodeRow]] = {}
    for row in rows:
        found.setdefault(format_sim_params(row.sim_params), []).append(row)
    return found


def _by_place(rows: Iterable[EpisodeRow]) -> dict[_Place, float]:
    found: dict[_Place, list[float]] = {}
    for row in rows:
        found.setdefault(_place(row), []).append(row.episode_return)
    return {place: float(np.mean(values)) for place, values in found.items()}


def _place(row: EpisodeRow) -> _Place:
    return row.env, format_sim_params(row.sim_params), row.length
