"""Which runs belong together: a series is one method with one set of settings, over seeds."""

import dataclasses
import functools
from collections.abc import Mapping, Sequence
from typing import Any

from headway import settings
from headway.experiment.methods import METHODS
from headway.report.page.runs import LoadedRun, Note
from headway.report.page.scoring import REFERENCES, Outcome, References, outcome

_NAMES = ("env", "method", "seed", *settings.TOLERANCE)  # differ without making a variant
_SWATCHES = 8


@dataclasses.dataclass(frozen=True)
class Series:
    """A method, or one variant of it, as it looks in every figure."""

    label: str
    index: int
    """Position among all series; decides colour, marker and dashes."""

    @property
    def swatch(self) -> int:
        """Number of its colour."""
        return self.index % _SWATCHES

    @property
    def round(self) -> int:
        """How often the colours were used up before; decides dashes."""
        return self.index // _SWATCHES


@dataclasses.dataclass(frozen=True)
class Comparison:
    """Runs of several methods in several environments."""

    runs: Mapping[tuple[str, str], list[LoadedRun]]
    """Runs by environment and label of their series, in the order of seeds."""
    series: list[Series]
    references: References
    """Returns that scores are normalised with."""
    notes: list[Note]

    @classmethod
    def of(cls, runs: Sequence[LoadedRun], notes: Sequence[Note] = ()) -> "Comparison":
        """Sort runs into series."""
        references = References.of(runs)
        compared = [run for run in runs if run.config.method not in REFERENCES] or runs
        labels = series_labels(compared)
        order = list(METHODS)
        methods = sorted(
            {run.config.method for run in compared},
            key=lambda name: (order.index(name) if name in order else len(order), name),
        )
        names = [
            label
            for method in methods
            for label in dict.fromkeys(
                label
                for run, label in zip(compared, labels, strict=True)
                if run.config.method == method
            )
        ]
        found: dict[tuple[str, str], list[LoadedRun]] = {}
        for run, label in zip(compared, labels, strict=True):
            found.setdefault((run.config.env, label), []).append(run)
        series = [Series(label, index) for index, label in enumerate(names)]
        return cls(found, series, references, list(notes))

    @functools.cached_property
    def outcomes(self) -> dict[tuple[str, str, str], list[Outcome]]:
        """Of every finished run, by environment, label and group, in the order of seeds."""
        found: dict[tuple[str, str, str], list[Outcome]] = {}
        for (env, label), runs in self.runs.items():
            for run in runs:
                for group in dict.fromkeys(row.group for row in run.tests):
                    rows = [row for row in run.tests if row.group == group]
                    places = found.setdefault((env, label, group), [])
                    places.append(outcome(rows, self.references, run.config))
        return found

    @functools.cached_property
    def envs(self) -> list[str]:
        """Environments that were run, in alphabetical order."""
        return sorted({env for env, _ in self.runs})

    @property
    def run_count(self) -> int:
        """Runs that are compared."""
        return sum(map(len, self.runs.values()))

    def series_of(self, env: str) -> list[Series]:
        """The series that were run in an environment."""
        return [series for series in self.series if (env, series.label) in self.runs]

    def runs_of(self, env: str, series: Series | None = None) -> list[LoadedRun]:
        """The runs of a series in an environment; of all of them by default."""
        chosen = self.series_of(env) if series is None else [series]
        return [run for one in chosen for run in self.runs.get((env, one.label), [])]

    def label_of(self, run: LoadedRun) -> str:
        """The label of the series that a run belongs to."""
        return next(label for (_, label), runs in self.runs.items() if run in runs)


def series_labels(runs: Sequence[LoadedRun]) -> list[str]:
    """Name every run by its method, and by what tells variants of a method apart.

    A setting counts if it differs between runs of the same method in the same environment,
    seeds aside; what only follows the environment does not.
    """
    flat = [_settings(run) for run in runs]
    differing: dict[str, list[str]] = {}
    for method in {run.config.method for run in runs}:
        for env in {run.config.env for run in runs}:
            same = [
                values
                for run, values in zip(runs, flat, strict=True)
                if (run.config.method, run.config.env) == (method, env)
            ]
            names = differing.setdefault(method, [])
            names += [name for name in differing_settings(same) if name not in names]
    return [
        ", ".join([run.config.method, *_variant(values, differing[run.config.method])])
        for run, values in zip(runs, flat, strict=True)
    ]


def differing_settings(values: Sequence[Mapping[str, Any]]) -> list[str]:
    """Names of the settings whose values are not all the same."""
    names = list(dict.fromkeys(name for table in values for name in table))
    return [n for n in names if any(table.get(n) != values[0].get(n) for table in values)]


def run_settings(run: LoadedRun) -> dict[str, Any]:
    """All settings of a run by dotted name; those that it cannot use stand at their defaults."""
    return settings.relevant(run.config)


def _settings(run: LoadedRun) -> dict[str, Any]:
    return {name: value for name, value in run_settings(run).items() if name not in _NAMES}


def _variant(values: Mapping[str, Any], names: Sequence[str]) -> list[str]:
    """Word what is special, for example `num heads 5`."""
    return [f"{name.rpartition('.')[2].replace('_', ' ')} {value_text(values.get(name))}"
            for name in names]  # fmt: skip


def value_text(value: Any) -> str:
    """Write a setting's value for readers."""
    if isinstance(value, bool):
        return "on" if value else "off"
    if value is None:
        return "–"
    if isinstance(value, list):
        return " ".join(map(value_text, value))
    text = f"{value:.7g}" if isinstance(value, float) else str(value)
    return text.replace("-", "−") if isinstance(value, int | float) else text
