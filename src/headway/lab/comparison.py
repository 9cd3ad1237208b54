"""Experiments in one call: make the runs that are missing, then draw and tabulate what they found.

Writes a figure (PNG, SVG), every episode's return (CSV) and a table with what can be claimed
(Markdown); `results` has the same table for a terminal.
"""

import dataclasses
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import pandas as pd
from rich.table import Table

from headway.lab import figures, tables
from headway.lab.statistics import MIN_RUNS, caution, compare, estimate, unlike, verdict
from headway.lab.sweep import NOTE, Cell, Comparison, Workers, run_jobs
from headway.training.files import write_bytes, write_json

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

    @property
    def is_collected(self) -> bool:
        """Returns while collecting are compared, not those of tests."""
        return self.comparison.experiment.measure == tables.COLLECTED

    @property
    def parts(self) -> pd.DataFrame:
        """Returns by physics (`tables.by_physics`) after the last iteration of each arm."""
        last = self.episodes.groupby(["env", "label"]).iteration.transform("max")
        return tables.by_physics(self.episodes[self.episodes.iteration == last])

    @property
    def points(self) -> pd.DataFrame:
        """Return on unseen physics, or while collecting, by run and iteration."""
        unseen = self.episodes[self.episodes.group != tables.TRAIN]
        keys = [*tables.SERIES, "iteration", "timesteps"]
        physics = unseen.groupby([*keys, "sim_params"], sort=False)["return"].mean()
        return physics.groupby(keys, sort=False).mean().reset_index()

    @property
    def last(self) -> pd.DataFrame:
        """The points after the last iteration of each arm: env, arm, seed, ..., value."""
        points = self.points
        last = points.groupby(["env", "label"]).iteration.transform("max")
        return points[points.iteration == last].rename(columns={"label": "arm", "return": "value"})


@dataclasses.dataclass(frozen=True)
class Reproduced:
    """A comparison as far as its runs got."""

    found: Found
    files: list[Path]
    """Figure (PNG and SVG), raw numbers (CSV) and table (Markdown)."""
    failures: Mapping[Path, str]
    """Why runs failed, by run directory; the others are drawn all the same."""


def reproduce(
    comparison: Comparison,
    *,
    workers: Workers | None = None,
    quiet: bool = True,
    command: str = "",
) -> Reproduced:
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
    failures = run_jobs(comparison.jobs, workers or Workers(), quiet=quiet)
    found = find(comparison)
    write_json(comparison.folder / NOTE, comparison.facts)
    path = comparison.folder / f"{comparison.experiment.name}.csv"
    raw = found.episodes.rename(columns={"label": "arm"})
    raw["run"] = [Path(run).relative_to(comparison.out).as_posix() for run in raw["run"]]
    raw["experiment"] = comparison.experiment.name
    write_bytes(path, raw.to_csv(columns=RAW_COLUMNS, index=False).encode())
    return Reproduced(found, [*draw(found), path, write_table(found, command)], failures)


def find(comparison: Comparison) -> Found:
    """Read the finished runs of a comparison; a damaged one counts as missing."""
    done, missing = {}, []
    for cell, job in comparison.cells.items():
        if job.state.name == "done":
            done[cell] = str(job.path)
        else:
            missing.append(cell)
    columns = [*RAW_COLUMNS, "label", "score", "protocol"]
    if not done:
        return Found(comparison, pd.DataFrame(columns=columns), missing)
    runs = tables.read_runs(done.values())
    episodes = runs.episodes
    if comparison.experiment.measure == tables.COLLECTED:
        episodes = runs.collected.assign(sim_params="", score=float("nan"))
    steps = runs.curves[["run", "iteration", "timesteps"]].drop_duplicates()
    names = runs.runs[["run", "preset"]]
    measured = episodes.merge(steps, on=["run", "iteration"]).merge(names, on="run")
    cells = pd.DataFrame(
        [(*cell, run) for cell, run in done.items()], columns=["env", "label", "seed", "run"]
    )
    episodes = cells.merge(measured.drop(columns=["env", "label", "seed"]), on="run")
    return Found(comparison, episodes, missing)


def draw(found: Found) -> list[Path]:
    """Draw returns over environment steps, or the last ones where only these were measured.

    Returns:
        The PNG and the SVG file; nothing where no run is finished.
    """
    comparison, points = found.comparison, found.points
    envs = [env for env in comparison.envs if env in set(points.env)]
    if not envs:
        return []
    arms = comparison.experiment.arms
    looks = figures.arm_looks(arms)
    has_curves = points.duplicated(tables.SERIES).any()
    what = "while collecting" if found.is_collected else "unseen physics"
    seeds = ", ".join(map(str, comparison.seeds))
    marks = "Lines are means over seeds; bands are 95 % intervals of the mean, from three seeds on."
    if not has_curves:
        marks = (
            "Dots are seeds after the last iteration, bars their mean, lines its 95 % interval"
            " from three seeds on. Scores, where known: 0 is random, 1 the paper's planner on the"
            " true dynamics."
        )
    missing = f" {len(found.missing)} runs are not finished." * bool(found.missing)
    columns = 2 if len(envs) == 4 else min(len(envs), 3)
    lines = -(-len(envs) // columns)
    height = 2.6 if has_curves else 0.9 + 0.32 * len(arms)
    title = comparison.experiment.title
    title = f"{title[0].upper()}{title[1:]}" + f", {envs[0]}" * (len(comparison.envs) == 1)
    with figures.figure(
        comparison.folder / f"{comparison.experiment.name}.png",
        title=title,
        caption=f"Return, {what}; preset {comparison.preset}, seeds {seeds}. {marks}{missing}",
        size=(max(3.6 * columns, 6.8), height * lines),
        svg=True,
    ) as drawing:
        panels = drawing.subplots(lines, columns, squeeze=False, sharey=not has_curves)
        for axes in panels.flat[len(envs) :]:
            axes.set_visible(False)
        for axes, env in zip(panels.flat, envs, strict=False):
            own = points[points.env == env]
            if has_curves:
                figures.curves(axes, own.assign(finished=True), looks)
                axes.set_ylabel(f"return per episode,\n{what}" if axes in panels[:, 0] else "")
            else:
                order = _order(found) if figures.are_methods(arms) else list(looks)
                scores = {arm: _score(found, env, arm) for arm in order}
                values = found.last[found.last.env == env].rename(columns={"arm": "label"})
                shown = {arm: looks[arm] for arm in order}
                figures.dots(axes, values, shown, f"return per episode, {what}", scores)
            if len(comparison.envs) > 1:
                axes.set_title(env)
        if has_curves:
            figures.legend(drawing, looks)
    path = comparison.folder / f"{comparison.experiment.name}.png"
    return [path, path.with_suffix(".svg")]


def _order(found: Found) -> list[str]:
    """Arms from the best to the worst mean return, by mean rank over environments."""
    means = found.last.pivot_table(index="arm", columns="env", values="value")
    labels = [arm.label for arm in found.comparison.experiment.arms]
    ranks = means.reindex(labels).fillna(-float("inf")).rank(ascending=False).mean(axis=1)
    return list(ranks.sort_values(kind="stable").index)


def _score(found: Found, env: str, arm: str) -> str:
    """Mean score of an arm on unseen groups, from the runs that have one on all of them."""
    parts = found.parts
    own = parts[(parts.env == env) & (parts.label == arm) & (parts.group != tables.TRAIN)]
    groups = own.groupby(["run", "group"]).score.agg(lambda scores: scores.mean(skipna=False))
    mean = groups.groupby("run").agg(lambda scores: scores.mean(skipna=False)).mean()
    return "–" if pd.isna(mean) else f"{mean:.2f}"


def table_columns(found: Found) -> list[str]:
    """The headings of the table."""
    iqm = "interquartile mean (95 %)"
    if found.is_collected:
        return ["arm", "seeds", "return while collecting", iqm]
    return ["arm", "seeds", "return on unseen physics", iqm, "on training physics", "score"]


def table_rows(found: Found, env: str) -> list[list[str]]:
    """A line of cells for every arm in one environment."""
    parts, last, lines = found.parts, found.last, []
    for arm in found.comparison.experiment.arms:
        own = (last.env == env) & (last.arm == arm.label)
        values = last.loc[own, "value"].to_numpy(float)
        middle = estimate([values[:, None]]) if len(values) else None
        interval = "–"
        if middle and middle.interval:
            interval = "{:,.1f} ({:,.1f} to {:,.1f})".format(middle.value, *middle.interval)
        line = [arm.label, str(len(values)), spread(values), interval]
        if not found.is_collected:
            own = parts[(parts.env == env) & (parts.label == arm.label)]
            trained = own[own.group == tables.TRAIN].groupby("run").return_mean.mean()
            line += [spread(trained), _score(found, env, arm.label)]
        lines.append(line)
    return lines


def spread(values: Sequence[float] | pd.Series) -> str:
    """Word the mean and the standard deviation over seeds."""
    numbers = pd.Series(values, dtype=float)
    if numbers.empty:
        return "–"
    return f"{numbers.mean():,.1f}" + (f" ± {numbers.std():,.1f}" if len(numbers) > 1 else "")


def verdicts(found: Found) -> list[str]:
    """Compare the reference of the experiment with every other arm, over all environments.

    The last lines name what is left out, and warn of intervals that come from too few seeds.
    """
    reference = found.comparison.experiment.reference_arm.label
    parts = found.parts[found.parts.group != tables.TRAIN]
    lines, counts, strange = [], [], []
    for arm in found.comparison.experiment.arms:
        if arm.label == reference:
            continue
        both = parts[parts.label.isin([reference, arm.label])]
        strange += [f"{arm.label} on {env}" for env in dict(unlike(both))]
        shown = compare(parts, reference, arm.label, "return_mean")
        if shown is not None:
            lines.append(verdict(reference, arm.label, shown))
            counts += [shown.num_runs] * bool(shown.interval)
    if strange:
        lines.append(
            f"Not compared with {reference}, because physics, episode lengths or options of the"
            f" environment differ: {'; '.join(strange)}."
        )
    warning = caution(min(counts)) if counts else ""
    return [*lines, warning] if warning else lines


def write_table(found: Found, command: str) -> Path:
    """Write the returns after the last iteration, what can be claimed, and the command."""
    comparison, columns = found.comparison, table_columns(found)
    experiment, few = comparison.experiment, len(comparison.seeds) < MIN_RUNS
    changed = "".join(f", {name} {value}" for name, value in comparison.settings.items())
    lines = [
        f"# {experiment.name}: {experiment.title}",
        "",
        f"Preset `{comparison.preset}`{changed}, seeds {', '.join(map(str, comparison.seeds))}."
        " Mean ± standard deviation over seeds after the last iteration; interquartile mean with"
        " its 95 % stratified bootstrap interval. Every physics of a group counts once. The score"
        " is that on unseen physics: 0 is random, 1 the paper's planner on the true dynamics.",
    ]
    if few:
        lines.append(f"Fewer than {MIN_RUNS} seeds: no difference between arms can be claimed.")
    if found.missing:
        names = "; ".join(f"{cell.env}, {cell.arm}, seed {cell.seed}" for cell in found.missing)
        lines.append(f"Not finished: {names}.")
    for env in comparison.envs:
        cells = [columns, ["---"] * len(columns), *table_rows(found, env)]
        lines += ["", f"## {env}", "", *(f"| {' | '.join(line)} |" for line in cells)]
    if not few:
        lines += ["", "## What can be claimed", "", *(f"- {line}" for line in verdicts(found))]
    if command:
        lines += ["", "The command, which resumes what was interrupted:", "", f"    {command}"]
    path = comparison.folder / f"{experiment.name}.md"
    write_bytes(path, "\n".join([*lines, ""]).encode())
    return path


def results(found: Found) -> list[Table]:
    """Lay out what was found for a terminal: a table per environment."""
    made = []
    for env in found.comparison.envs:
        title = f"{found.comparison.experiment.name}, {env}"
        made.append(tables.new_table(title, "arm", numbers=table_columns(found)[1:]))
        for cells in table_rows(found, env):
            made[-1].add_row(*cells)
    return made


def states(comparison: Comparison) -> tuple[list[dict[str, Any]], Table]:
    """Describe every run of a comparison and how far it is, as plain values and as a table."""
    table = tables.new_table(f"Runs of {comparison.experiment.name}", "run", "arms", "state")
    table.add_column("iterations", justify="right")
    entries, cells = [], comparison.cells
    for job in comparison.jobs:
        state, total = job.state, job.config.collection.num_iterations
        arms = [cell.arm for cell, other in cells.items() if other.path == job.path]
        facts = {"run_dir": str(job.path), "arms": arms, "state": state.name, "note": state.note}
        entries.append({**facts, "finished_iterations": state.iterations, "iterations": total})
        note = f"{state.name} {state.note}".rstrip()
        table.add_row(job.name, ", ".join(arms), note, f"{state.iterations}/{total}")
    missing = sum(one["state"] in ("missing", "begun") for one in entries)
    table.caption = f"{missing} of {len(entries)} runs are missing"
    return entries, table
