"""What an experiment needs: one run per arm, environment and seed, each with its directory.

A run's directory is named by every setting that its results depend on, so that whoever needs
the same run finds it, and two different ones never meet.
"""

import dataclasses
import hashlib
import json
from collections.abc import Iterable
from pathlib import Path
from typing import Any, NamedTuple

from headway.config import Config, differences, flatten, to_dict, tolerating_as
from headway.errors import ConfigError, RunError
from headway.sweeps import results_folder
from headway.sweeps.experiments import Arm, Experiment, Settings
from headway.task import env_spec
from headway.training.methods import make_config
from headway.training.run import RunDir


class Cell(NamedTuple):
    """A place in the table of an experiment."""

    env: str
    arm: str
    seed: int


@dataclasses.dataclass(frozen=True)
class Job:
    """A run to be made: its settings, and the directory that is its alone."""

    config: Config
    path: Path

    @classmethod
    def of(cls, config: Config, out: Path) -> "Job":
        """The job of a configuration, under the directory of all results."""
        named = f"{config.method}-{config.preset}-{fingerprint(config)}"
        return cls(config, out / "runs" / config.env / named / f"seed{config.seed}")

    @property
    def num_iterations(self) -> int:
        """Iterations of the whole run."""
        return self.config.collection.num_iterations

    @property
    def finished_iterations(self) -> int:
        """Iterations that are complete already.

        Raises:
            RunError: The directory holds a run with other settings, or a damaged one.
        """
        if not (self.path / "config.json").exists():
            return 0
        run = RunDir(self.path)
        begun_with = tolerating_as(run.config(), self.config)
        found = differences(begun_with, self.config)
        if found:
            raise RunError(
                f"{self.path} holds a run with other settings ({'; '.join(found)}), perhaps of an"
                " older version; choose another --out, or move it away."
            )
        return len(run.metrics())

    @property
    def finished(self) -> bool:
        """Whether nothing is missing.

        Raises:
            RunError: The directory holds a run with other settings, or a damaged one.
        """
        return self.finished_iterations >= self.num_iterations


@dataclasses.dataclass(frozen=True)
class Comparison:
    """An experiment in some environments, with some seeds, at a scale, in a directory."""

    experiment: Experiment
    envs: tuple[str, ...]
    seeds: tuple[int, ...]
    preset: str
    out: Path
    """Runs go to `runs/` in it, the figure, CSV and table to a folder of their own."""
    settings: Settings = dataclasses.field(default_factory=dict)
    """Changes of every arm by dotted name; what an arm itself sets wins."""

    def __post_init__(self):
        object.__setattr__(self, "envs", tuple(env_spec(env).name for env in self.envs))
        for name in ("envs", "seeds"):
            values = getattr(self, name)
            if not values or len(set(values)) < len(values):
                raise ConfigError(f"{name} is {values}, allowed: one or more, each once.")

    @property
    def usual_folder(self) -> Path:
        """Where the figure, the raw numbers and the table go, unless others are there."""
        return self.out / f"{self.experiment.name}-{self.preset}"

    @property
    def folder(self) -> Path:
        """Where they go; it depends on what is there already (`results_folder`)."""
        return results_folder.choose(self.usual_folder, self.facts)

    @property
    def facts(self) -> dict[str, Any]:
        """All that is compared, as plain values."""
        return {
            "experiment": self.experiment.name,
            "measure": self.experiment.measure,
            "reference": self.experiment.reference,
            "preset": self.preset,
            "settings": dict(self.settings),
            "envs": self.envs,
            "seeds": self.seeds,
            "arms": [
                {"label": arm.label, "method": arm.method, "settings": dict(arm.settings)}
                for arm in self.experiment.arms
            ],
        }

    @property
    def cells(self) -> dict[Cell, Job]:
        """Every place of the table with the job that fills it; several may share one.

        The order is that in which the jobs are best done: all arms with the first seed first.

        Raises:
            UnknownNameError: No such environment, method or preset.
            ConfigError: A setting is unknown, of the wrong type or out of range.
        """
        return {
            Cell(env, arm.label, seed): Job.of(self._config(arm, env, seed), self.out)
            for seed in self.seeds
            for env in self.envs
            for arm in self.experiment.arms
        }

    @property
    def jobs(self) -> list[Job]:
        """Every job once."""
        return unique(self.cells.values())

    def _config(self, arm: Arm, env: str, seed: int) -> Config:
        chosen = {**self.settings, **arm.settings}
        return make_config(env, method=arm.method, preset=self.preset, seed=seed, settings=chosen)


def unique(jobs: Iterable[Job]) -> list[Job]:
    """The jobs without repetitions; a run is known by its directory."""
    return list({job.path: job for job in jobs}.values())


def fingerprint(config: Config) -> str:
    """Ten letters that stand for all settings that a run's results depend on, but the seed.

    Only what differs from the defaults counts, so a setting that a later version adds does not
    give the same run another name. What the run cannot use, or only tolerates
    (`config.TOLERANCE`), counts as its method and preset have it, whatever it is here: so it
    tells no runs apart, and those of before keep their names.
    """
    names = {"method": config.method, "preset": config.preset, "seed": config.seed}
    usual = make_config(config.env, **names)
    plain = flatten(to_dict(Config(env=config.env, **names)))
    tolerating = tolerating_as(config, usual)
    changed = sorted(_lines(flatten(to_dict(tolerating))) - _lines(plain))
    return hashlib.sha256("\n".join(changed).encode()).hexdigest()[:10]


def _lines(flat: Settings) -> set[str]:
    """Every setting as one line of text."""
    return {f"{name}={json.dumps(value)}" for name, value in flat.items()}
