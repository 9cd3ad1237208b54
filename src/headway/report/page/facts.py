"""The chapters of the page that say how its numbers came about."""

import shlex
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from headway.report.page import charts, svg
from headway.report.page.measures import RAW_COLUMNS, raw_rows
from headway.report.page.parts import Block, Cell, Line, Panel, Section, Table, identifier
from headway.report.page.runs import PHYSICS_FILE, LoadedRun, physics_file, train_command
from headway.report.page.series import (
    Comparison,
    run_settings,
    value_text,
)
from headway.training.run import csv_text

PHASES = ("collect", "fit", "evaluate")
_TEXTS = ("env", "method", "group", "sim_params")


def settings(comparison: Comparison) -> Section:
    """The settings in which the runs of an environment differ."""
    lead = (
        "Settings that are not the same in all runs that use them, by environment; seeds and what"
        " is tolerated of environments that break aside. A dash stands where a method has no use"
        " for a setting. Everything else that the runs use is equal."
    )
    blocks = [_settings_of(comparison, env) for env in comparison.envs]
    return Section("settings", "Settings that differ", lead, blocks)


def _settings_of(comparison: Comparison, env: str) -> Block:
    series = comparison.series_of(env)
    tables = [run_settings(comparison.runs_of(env, one)[0]) for one in series]
    names = [name for name in _disputed(tables) if name not in ("method", "seed")]
    if not names:
        return Block(env, texts=["All runs have the same settings."])
    lines = [
        Line([Cell(name, is_code=True), *(Cell(value_text(table.get(name))) for table in tables)])
        for name in names
    ]
    return Block(env, table=Table(["setting", *(one.label for one in series)], lines))


def _disputed(tables: Sequence[Mapping[str, Any]]) -> list[str]:
    """Names of the settings that not all tables which have them agree on."""
    names = dict.fromkeys(name for table in tables for name in table)
    given = {name: [table[name] for table in tables if name in table] for name in names}
    return [name for name, values in given.items() if any(v != values[0] for v in values)]


def times(comparison: Comparison) -> Section:
    """How long runs took."""
    blocks = []
    for env in comparison.envs:
        bars, lines = [], []
        for series in comparison.series_of(env):
            runs = [run for run in comparison.runs_of(env, series) if run.is_finished]
            if not runs:
                continue
            taken = [run_minutes(run) for run in runs]
            minutes = {phase: float(np.mean([one[phase] for one in taken])) for phase in PHASES}
            bars.append((series, minutes))
            cells = [_minutes(minutes[phase]) for phase in PHASES]
            cells.append(_minutes(sum(minutes.values())))
            devices = ", ".join(sorted({run.device for run in runs}))
            named = Cell(series.label, is_key=True)
            lines.append(Line([named, *cells, Cell(devices)], series.index))
        if not bars:
            blocks.append(Block(env, texts=["No run is finished yet."]))
            continue
        drawn = svg.panel(
            lambda axes, bars=bars: charts.run_times(axes, bars),
            name=identifier("times", env),
            label=f"Minutes per run of each method on {env}",
            size=(3.5, 0.72 + 0.24 * len(bars)),
        )
        columns = ["method", *(f"{phase}, min" for phase in PHASES), "all, min", "device"]
        blocks.append(Block(env, [Panel("", drawn)], Table(columns, lines)))
    lead = (
        "Minutes per finished run, mean over seeds; from full to pale: collecting, fitting,"
        " testing. They are comparable only where the runs had the machine to themselves."
    )
    return Section("times", "Run times", lead, blocks)


def run_minutes(run: LoadedRun) -> dict[str, float]:
    """Minutes of each phase over all iterations."""
    return {
        phase: sum(row.get("seconds", {}).get(phase, 0.0) for row in run.metrics) / 60
        for phase in PHASES
    }


def _minutes(value: float) -> Cell:
    return Cell(f"{value:,.1f}", is_number=True)


def sources(comparison: Comparison) -> Section:
    """The runs, and the command that makes each."""
    lines = [
        _source(run, series.label, series.index)
        for env in comparison.envs
        for series in comparison.series_of(env)
        for run in comparison.runs_of(env, series)
    ]
    labelled = zip(comparison.reference_runs, comparison.reference_labels, strict=True)
    lines += [_source(run, label) for run, label in labelled]
    table = Table(["run, and the command that makes it", "method", "seed", "iterations"], lines)
    lead = "Every run on this page. The command resumes a run that was interrupted."
    if comparison.reference_runs:
        lead += " Runs without a symbol are references: scores are normalised by them."
    return Section("runs", "Runs", lead, [Block(table=table)])


def _source(run: LoadedRun, label: str, series: int | None = None) -> Line:
    done = f"{len(run.metrics)} of {run.config.collection.num_iterations}"
    below = [shlex.join(train_command(run))]
    if physics := physics_file(run):
        below.append(f"{PHYSICS_FILE}: {physics}")
    cells = [
        Cell(str(run.path), below, is_code=True),
        Cell(label, is_key=series is not None),
        Cell(str(run.config.seed), is_number=True),
        Cell(done, is_number=True),
    ]
    return Line(cells, series)


def numbers(comparison: Comparison) -> Section:
    """The raw numbers, to look at and to copy."""
    rows = raw_rows(comparison)
    index = {series.label: series.index for series in comparison.series}
    shown = RAW_COLUMNS[:-1]
    lines = [
        Line(
            [_raw_cell(name, row[name], row["method"] in index) for name in shown],
            index.get(row["method"]),
        )
        for row in rows
    ]
    lead = (
        "Each finished run's test episodes for every physics: mean and standard deviation over"
        " episodes. Runs without a symbol are references."
    )
    blocks = [Block(table=Table([name.replace("_", " ") for name in shown], lines))]
    csv = csv_text(RAW_COLUMNS, rows)
    if not rows:
        blocks, csv = [Block(texts=["No run is finished yet."])], ""
    return Section("numbers", "Raw numbers", lead, blocks, csv=csv)


def _raw_cell(column: str, value: object, has_symbol: bool) -> Cell:
    text = value_text(value)
    is_key = has_symbol and column == "method"
    return Cell(text, is_number=column not in _TEXTS, is_key=is_key)
