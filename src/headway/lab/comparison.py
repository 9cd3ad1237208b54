"""Experiments in one call: make the runs that are missing, then draw and tabulate what they found.

Writes a figure (PNG, SVG), every episode's return (CSV) and a table with what can be claimed
(Markdown).
"""

import dataclasses
import functools
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import pandas as pd
from rich.table import Table

from headway.lab import figures, report, tables
from headway.lab.statistics import MIN_RUNS, caution, compare, estimate, mismatches, verdict
from headway.lab.sweep import NOTE, Cell, Comparison, Workers, run_jobs
from headway.training.files import write_bytes, write_json

NONE = "–"
RAW_COLUMNS = [
    "experiment", "arm", "env", "method", "preset", "seed", "iteration", "timesteps", "group",
    "sim_params", "episode", "return", "run",
]  # fmt: skip


@dataclasses.dataclass(frozen=True)
class Found:
    """Measurements of the finished runs of a comparison."""

    comparison: Comparison
    episodes: pd.DataFrame
    """Every episode that the experiment looks at; `label` is its arm."""
    missing: Sequence[Cell]
    """Places of the table whose run is not finished."""
    failures: Mapping[Path, str] = dataclasses.field(default_factory=dict)
    """Why runs failed, by run directory; the others are drawn all the same."""
    files: Sequence[Path] = ()
    """Figure (PNG and SVG), raw numbers (CSV) and, last, the table (Markdown)."""

    @functools.cached_property
    def parts(self) -> pd.DataFrame:
        """Returns by physics (`tables.by_physics`) after the last iteration of each arm."""
        return tables.by_physics(_last(self.episodes))

    @functools.cached_property
    def points(self) -> pd.DataFrame:
        """Return on unseen physics, or while collecting, by run and iteration."""
        unseen = self.episodes[self.episodes.group != tables.TRAIN]
        keys = [*tables.SERIES, "iteration", "timesteps"]
        physics = unseen.groupby([*keys, "sim_params"], sort=False)["return"].mean()
        return physics.groupby(keys, sort=False).mean().reset_index()

    @functools.cached_property
    def last(self) -> pd.DataFrame:
        """The points after the last iteration of each arm: env, arm, seed, ..., value."""
        return _last(self.points).rename(columns={"label": "arm", "return": "value"})


def _last(table: pd.DataFrame) -> pd.DataFrame:
    """Rows of the last iteration of each arm."""
    newest = table.groupby(["env", "label"]).iteration.transform("max")
    return table[table.iteration == newest]


def _is_collected(comparison: Comparison) -> bool:
    """Returns while collecting are compared, not those of tests."""
    return comparison.experiment.measure == tables.COLLECTED


def reproduce(
    comparison: Comparison,
    *,
    workers: Workers | None = None,
    quiet: bool = True,
    command: str = "",
) -> Found:
    """Make every run of a comparison that is missing, and write figure, CSV and table.

    Begun runs go on where they stand, finished ones are used as they are, also by other
    experiments with the same `out`. The files replace those of the same comparison with fewer
    environments, seeds or arms, and no others.

    Args:
        comparison: The experiment, environments, seeds and scale.
        workers: Where the runs are made; on Ray on this machine by default, where installed.
        quiet: Say nothing on stderr.
        command: The command line that asked for this; it is written below the table.

    Raises:
        UnknownNameError: No such environment, method or preset.
        ConfigError: A setting is unknown, of the wrong type or out of range.
    """
    folder = comparison.folder  # whose files are read, and may be damaged
    failures = run_jobs(comparison.jobs, workers or Workers(), quiet=quiet)
    found = find(comparison)
    write_json(folder / NOTE, comparison.facts)
    path = folder / f"{comparison.experiment.name}.csv"
    raw = found.episodes.rename(columns={"label": "arm"})
    raw["run"] = [Path(run).relative_to(comparison.out).as_posix() for run in raw["run"]]
    raw["experiment"] = comparison.experiment.name
    write_bytes(path, raw.to_csv(columns=RAW_COLUMNS, index=False).encode())
    text = report.render(
        "comparison.md.jinja",
        comparison=comparison,
        missing=found.missing,
        tables={env: table(found, env) for env in comparison.envs},
        claims=verdicts(found) if len(comparison.seeds) >= MIN_RUNS else None,
        min_runs=MIN_RUNS,
        command=command,
    )
    write_bytes(path.with_suffix(".md"), text.encode())
    files = [*draw(found), path, path.with_suffix(".md")]
    return dataclasses.replace(found, failures=failures, files=files)


def find(comparison: Comparison) -> Found:
    """Read the finished runs of a comparison; a damaged one counts as missing."""
    cells = {cell: job for cell, job in comparison.cells.items() if job.state.name == "done"}
    missing = [cell for cell in comparison.cells if cell not in cells]
    done = pd.DataFrame(
        [(*cell, str(job.path)) for cell, job in cells.items()], columns=tables.SERIES
    )
    if done.empty:
        columns = [*RAW_COLUMNS, "label", "score", "protocol"]
        return Found(comparison, pd.DataFrame(columns=columns), missing)
    runs = tables.read_runs(done["run"])
    episodes = runs.episodes
    if _is_collected(comparison):
        episodes = runs.collected.assign(sim_params="", score=float("nan"))
    steps = runs.curves[["run", "iteration", "timesteps"]].drop_duplicates()
    measured = episodes.merge(steps, on=["run", "iteration"]).assign(preset=comparison.preset)
    episodes = done.merge(measured.drop(columns=["env", "label", "seed"]), on="run")
    return Found(comparison, episodes, missing)


def draw(found: Found) -> list[Path]:
    """Draw returns over environment steps, or the last ones where only these were measured.

    Returns:
        The PNG and the SVG file; nothing where no run is finished.
    """
    comparison, points, last = found.comparison, found.points, found.last
    envs = [env for env in comparison.envs if env in set(points.env)]
    if not envs:
        return []
    arms, title = comparison.experiment.arms, comparison.experiment.title
    looks = figures.arm_looks(arms)
    has_curves = points.duplicated(tables.SERIES).any()
    marks = "Lines are means over seeds; bands are 95 % intervals of the mean, from three seeds on."
    if not has_curves:
        marks = (
            "Dots are seeds after the last iteration, bars their mean, lines its 95 % interval"
            " from three seeds on."
        )
    columns = 2 if len(envs) == 4 else min(len(envs), 3)
    lines = -(-len(envs) // columns)
    height = 2.6 if has_curves else 0.9 + 0.32 * len(arms)
    measure = "while collecting" if _is_collected(comparison) else "unseen physics"
    seeds = ", ".join(map(str, comparison.seeds))
    missing = f" {len(found.missing)} runs are not finished." * bool(found.missing)
    path = comparison.folder / f"{comparison.experiment.name}.png"
    with figures.figure(
        path,
        title=title[0].upper() + title[1:] + f", {envs[0]}" * (len(comparison.envs) == 1),
        caption=f"Return, {measure}; preset {comparison.preset}, seeds {seeds}. {marks}{missing}",
        size=(max(3.6 * columns, 6.8), height * lines),
        looks=looks if has_curves else None,
        svg=True,
    ) as drawing:
        panels = drawing.subplots(lines, columns, squeeze=False, sharey=not has_curves)
        for axes in panels.flat[len(envs) :]:
            axes.set_visible(False)
        for axes, env in zip(panels.flat, envs, strict=False):
            if has_curves:
                figures.curves(axes, points[points.env == env].assign(finished=True), looks)
                axes.set_ylabel(f"return per episode,\n{measure}" if axes in panels[:, 0] else "")
            else:
                values = last[last.env == env].rename(columns={"arm": "label"})
                figures.dots(axes, values, looks, f"return per episode, {measure}")
            if len(comparison.envs) > 1:
                axes.set_title(env)
    return [path, path.with_suffix(".svg")]


def table(found: Found, env: str) -> list[list[str]]:
    """Headings, and a line of cells for every arm in one environment."""
    parts, last, is_collected = found.parts, found.last, _is_collected(found.comparison)
    lines = [["arm", "seeds", "return on unseen physics", "interquartile mean (95 %)"]]
    if is_collected:
        lines[0][2] = "return while collecting"
    else:
        lines[0] += ["on training physics", "score"]
    for arm in found.comparison.experiment.arms:
        values = last.loc[(last.env == env) & (last.arm == arm.label), "value"].to_numpy(float)
        middle = estimate([values[:, None]]) if len(values) else None
        interval = NONE
        if middle and middle.interval:
            interval = "{:,.1f} ({:,.1f} to {:,.1f})".format(middle.value, *middle.interval)
        lines.append([arm.label, str(len(values)), spread(values), interval])
        if not is_collected:
            own = parts[(parts.env == env) & (parts.label == arm.label)]
            is_trained = own.group == tables.TRAIN
            trained = own[is_trained].groupby("run").return_mean.mean()
            unseen = own[~is_trained].groupby("run").filter(lambda run: run.score.notna().all())
            score = unseen.groupby("run").score.mean().mean()
            lines[-1] += [spread(trained), NONE if pd.isna(score) else f"{score:.2f}"]
    return lines


def spread(values: Sequence[float] | pd.Series) -> str:
    """Word the mean and the standard deviation over seeds."""
    numbers = pd.Series(values, dtype=float)
    if numbers.empty:
        return NONE
    return f"{numbers.mean():,.1f}" + (f" ± {numbers.std():,.1f}" if len(numbers) > 1 else "")


def verdicts(found: Found) -> list[str]:
    """Compare the reference of the experiment with every other arm, over all environments.

    The last lines name what is left out, and warn of intervals that come from too few seeds.
    """
    experiment = found.comparison.experiment
    reference = experiment.reference or experiment.arms[0].label
    parts = found.parts[found.parts.group != tables.TRAIN]
    lines, counts, apart = [], [], []
    for arm in experiment.arms:
        if arm.label == reference:
            continue
        both = parts[parts.label.isin([reference, arm.label])]
        apart += [f"{arm.label} on {env}" for env in dict(mismatches(both))]
        shown = compare(parts, reference, arm.label, "return_mean")
        if shown is not None:
            lines.append(verdict(reference, arm.label, shown))
            counts += [shown.num_runs] * bool(shown.interval)
    if apart:
        lines.append(
            f"Not compared with {reference}, because physics, episode lengths or options of the"
            f" environment differ: {'; '.join(apart)}."
        )
    return [*lines, *filter(None, [caution(min(counts))] if counts else [])]


def states(comparison: Comparison) -> tuple[list[dict[str, Any]], Table]:
    """Describe every run of a comparison and how far it is, as plain values and as a table."""
    title = f"Runs of {comparison.experiment.name}"
    table = tables.new_table(title, "run", "arms", "state", numbers=["iterations"])
    entries = []
    for job in comparison.jobs:
        (name, done, note), total = job.state, job.config.collection.num_iterations
        arms = [arm for (_, arm, _), other in comparison.cells.items() if other.path == job.path]
        facts = {"run_dir": str(job.path), "arms": arms, "state": name, "note": note}
        entries.append({**facts, "finished_iterations": done, "iterations": total})
        table.add_row(job.name, ", ".join(arms), f"{name} {note}".rstrip(), f"{done}/{total}")
    missing = sum(one["state"] in ("missing", "begun") for one in entries)
    table.caption = f"{missing} of {len(entries)} runs are missing"
    return entries, table
