"""Scores: returns between those of random actions and of the planner on the true dynamics."""

import dataclasses
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np

from headway.config import Config
from headway.report.page.runs import LoadedRun, Note
from headway.task import env_names, env_options, episode_length
from headway.training.references import mean_score, normalised, score_of
from headway.training.run import EpisodeRow, format_sim_params

RANDOM = "random"
CEILING = "true-dynamics"
REFERENCES = (RANDOM, CEILING)

Place = tuple[str, str, int, str]
"""Environment, physics, steps of an episode, options."""

_Search = tuple[Any, ...]  # the settings of the planner's search
_SEARCH = ("optimizer", "horizon", "num_candidates", "num_iterations", "reward")


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

    returns: Mapping[tuple[str, Place], Mapping[_Search, float]]
    """By method and place, and by how the reference planned: several planners, several returns."""

    @classmethod
    def of(cls, runs: Sequence[LoadedRun]) -> "References":
        """Take the references among runs; every seed of a place and a planner counts once."""
        found: dict[tuple[str, Place], dict[_Search, list[float]]] = {}
        for run in runs:
            if run.config.method in REFERENCES:
                for place, value in _by_place(run.tests, run.config).items():
                    variants = found.setdefault((run.config.method, place), {})
                    variants.setdefault(_search(run.config), []).append(value)
        return cls(
            {
                place: {search: float(np.mean(values)) for search, values in variants.items()}
                for place, variants in found.items()
            }
        )

    def score(self, row: EpisodeRow, config: Config) -> float | None:
        """Score of one test episode of a run; None where no reference is known.

        References among the runs come first, then the project's own table. Where they planned in
        several ways, none of them the run's own, it is unknown which is meant.
        """
        if self._unclear(row, config):
            return None
        random, ceiling = (self._level(name, row, config) for name in REFERENCES)
        if random is None or ceiling is None or random == ceiling:
            return score_of(row, config)
        return normalised(row.episode_return, random, ceiling)

    def level(self, method: str, runs: Sequence[LoadedRun], group: str) -> float | None:
        """Mean return of a reference over the physics of a group.

        None if one lacks, or if runs that planned differently have different references.
        """
        found: dict[Place, set[float | None]] = {}
        for run in runs:
            for row in run.tests:
                if row.group == group:
                    levels = found.setdefault(place_of(row, run.config), set())
                    levels.add(self._level(method, row, run.config))
        alike = all(len(levels) == 1 for levels in found.values())
        return mean_score([next(iter(levels)) for levels in found.values()]) if alike else None

    def notes(self, runs: Sequence[LoadedRun]) -> list[Note]:
        """Name the runs whose score is unknown because the references planned in several ways."""
        text = (
            "no score: the runs of true-dynamics here planned in several ways, none of them as this"
            " run does (settings `planner`)."
        )
        unclear = [run for run in runs if any(self._unclear(row, run.config) for row in run.tests)]
        return [Note(run.path, text) for run in unclear]

    def describe(self, env: str) -> str:
        """Say where the references of an environment come from."""
        methods = {method for method, place in self.returns if place[0] == env}
        if methods == set(REFERENCES):
            return "normalised by the runs of random and true-dynamics given here"
        return "normalised by the project's reference returns"

    def _level(self, method: str, row: EpisodeRow, config: Config) -> float | None:
        """What a reference returned there: the only one, or else the one that planned alike."""
        variants = self.returns.get((method, place_of(row, config)), {})
        search = () if method == RANDOM else _search(config)
        return next(iter(variants.values())) if len(variants) == 1 else variants.get(search)

    def _unclear(self, row: EpisodeRow, config: Config) -> bool:
        known = (CEILING, place_of(row, config)) in self.returns
        return known and self._level(CEILING, row, config) is None


def outcome(rows: Sequence[EpisodeRow], references: References, config: Config) -> Outcome:
    """Summarise one run's test episodes of one group."""
    parts = by_physics(rows).values()
    returns = [np.mean([row.episode_return for row in same]) for same in parts]
    scores = [mean_score([references.score(row, config) for row in same]) for same in parts]
    return Outcome(float(np.mean(returns)), mean_score(scores))


def by_group(rows: Sequence[EpisodeRow]) -> dict[str, list[EpisodeRow]]:
    """Episodes by their group."""
    found: dict[str, list[EpisodeRow]] = {}
    for row in rows:
        found.setdefault(row.group, []).append(row)
    return found


def by_physics(rows: Sequence[EpisodeRow]) -> dict[str, list[EpisodeRow]]:
    """Episodes by their simulator parameters."""
    found: dict[str, list[EpisodeRow]] = {}
    for row in rows:
        found.setdefault(format_sim_params(row.sim_params), []).append(row)
    return found


def _by_place(rows: Iterable[EpisodeRow], config: Config) -> dict[Place, float]:
    found: dict[Place, list[float]] = {}
    for row in rows:
        found.setdefault(place_of(row, config), []).append(row.episode_return)
    return {place: float(np.mean(values)) for place, values in found.items()}


def place_of(row: EpisodeRow, config: Config) -> Place:
    """Where an episode was played: environment, physics, length, options."""
    physics, known = format_sim_params(row.sim_params), config.env in env_names()
    length = episode_length(config) if known else config.collection.episode_length
    options = env_options(config) if known else config.env_options
    return config.env, physics, length or 0, repr(sorted(options.items()))


def _search(config: Config) -> _Search:
    """How a run searches for actions; nothing for random ones."""
    if config.method == RANDOM:
        return ()
    planner = config.planner
    return tuple(getattr(planner, name) for name in _SEARCH)
