"""Which runs belong together: a series is one method with one set of settings, over seeds."""

import dataclasses
import functools
from collections.abc import Mapping, Sequence
from typing import Any

from headway.config import TOLERANCE, flatten, to_dict
from headway.report.page.runs import LoadedRun, Note
from headway.report.page.scoring import (
    REFERENCES,
    Outcome,
    Place,
    References,
    by_group,
    outcome,
    place_of,
)
from headway.training.methods import METHODS

_NAMES = ("env", "method", "seed", *TOLERANCE)  # differ without making a variant
_SWATCHES = 8
_LABEL = 60  # letters of a series' name


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
    reference_runs: list[LoadedRun]
    """The runs that the references come from; none where they are compared like methods."""
    notes: list[Note]

    @classmethod
    def of(cls, runs: Sequence[LoadedRun], notes: Sequence[Note] = ()) -> "Comparison":
        """Sort runs into series."""
        references = References.of(runs)
        others = [run for run in runs if run.config.method in REFERENCES]
        compared = [run for run in runs if run.config.method not in REFERENCES]
        if not compared:
            compared, others = others, []
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
        notes = [*notes, *references.notes(compared)]
        return cls(found, series, references, others, notes)

    @functools.cached_property
    def outcomes(self) -> dict[tuple[str, str], list[dict[str, Outcome]]]:
        """By environment and label: of every finished run its outcomes by group."""
        found: dict[tuple[str, str], list[dict[str, Outcome]]] = {}
        for place, runs in self.runs.items():
            tested = [(run, by_group(run.tests)) for run in runs if run.tests]
            found[place] = [
                {group: outcome(rows, self.references, run.config) for group, rows in of.items()}
                for run, of in tested
            ]
        return found

    @functools.cached_property
    def tasks(self) -> dict[tuple[str, str, str], frozenset[Place]]:
        """What was tested, by environment, label and group.

        Groups of one name may have other physics, episode lengths or options of the environment.
        """
        found: dict[tuple[str, str, str], set[Place]] = {}
        for (env, label), runs in self.runs.items():
            for run in runs:
                for row in run.tests:
                    places = found.setdefault((env, label, row.group), set())
                    places.add(place_of(row, run.config))
        return {name: frozenset(places) for name, places in found.items()}

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

    @functools.cached_property
    def reference_labels(self) -> list[str]:
        """How the reference runs are named, in their order."""
        return series_labels(self.reference_runs)

    def label_of(self, run: LoadedRun) -> str:
        """The label of the series that a run belongs to."""
        return next(label for (_, label), runs in self.runs.items() if run in runs)


def series_labels(runs: Sequence[LoadedRun]) -> list[str]:
    """Name every run by its method, and by what tells variants of a method apart.

    A setting counts if it differs between runs of the same method in the same environment,
    seeds aside; what only follows the environment or the preset does not. Labels that would be
    long end with a number; the page's settings say the rest.
    """
    flat = [_settings(run) for run in runs]
    names = _differing(runs, flat)
    labels = [
        ", ".join([run.config.method, *_variant(values, names[run.config.method])])
        for run, values in zip(runs, flat, strict=True)
    ]
    short = {}
    for method in names:
        of_method = [
            label for run, label in zip(runs, labels, strict=True) if run.config.method == method
        ]
        for number, label in enumerate(dict.fromkeys(of_method), 1):
            short[label] = _shortened(label, number)
    return [short[label] for label in labels]


def _differing(
    runs: Sequence[LoadedRun], flat: Sequence[Mapping[str, Any]]
) -> dict[str, list[str]]:
    """Names of the settings that tell variants apart, by method."""
    places: dict[tuple[str, str], list[Mapping[str, Any]]] = {}
    for run, values in zip(runs, flat, strict=True):
        places.setdefault((run.config.method, run.config.env), []).append(values)
    found: dict[str, list[str]] = {}
    for (method, _), same in places.items():
        names = found.setdefault(method, [])
        names += [name for name in _telling(same) if name not in names]
    return found


def _telling(values: Sequence[Mapping[str, Any]]) -> list[str]:
    """Settings that differ, without those that the preset explains."""
    presets = [
        [table for table in values if table["preset"] == preset]
        for preset in dict.fromkeys(table["preset"] for table in values)
    ]
    unexplained = {name for same in presets for name in differing_settings(same)}
    return [n for n in differing_settings(values) if n == "preset" or n in unexplained]


def _shortened(label: str, number: int) -> str:
    if len(label) <= _LABEL:
        return label
    return f"{label[:_LABEL].rpartition(', ')[0] or label[:_LABEL]}, … variant {number}"


def differing_settings(values: Sequence[Mapping[str, Any]]) -> list[str]:
    """Names of the settings whose values are not all the same."""
    names = list(dict.fromkeys(name for table in values for name in table))
    return [n for n in names if any(table.get(n) != values[0].get(n) for table in values)]


def run_settings(run: LoadedRun) -> dict[str, Any]:
    """All settings of a run by dotted name."""
    return flatten(to_dict(run.config))


def _settings(run: LoadedRun) -> dict[str, Any]:
    return {name: value for name, value in run_settings(run).items() if name not in _NAMES}


def _variant(values: Mapping[str, Any], names: Sequence[str]) -> list[str]:
    """Word what is special, for example `num heads 5`; sections tell equal names apart."""
    last = [name.rpartition(".")[2] for name in names]
    worded = []
    for name in names:
        parts = name.split(".")
        shown = parts[-1:] if last.count(parts[-1]) == 1 else parts[-2:]
        worded.append(f"{' '.join(shown).replace('_', ' ')} {value_text(values.get(name))}")
    return worded


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
