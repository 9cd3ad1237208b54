"""One page that compares runs and needs nothing else: no network, no script, no other file.

Its figures are Matplotlib's, inlined as SVG in the colours of the page's light or dark theme.
Everything that comes from a run is escaped, by Jinja or by Matplotlib.
"""

import base64
import dataclasses
import itertools
import shlex
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import jinja2
import numpy as np
import pandas as pd
from markupsafe import Markup
from matplotlib.axes import Axes

import headway
from headway.errors import ConfigError
from headway.lab import figures, statistics, tables
from headway.lab.tables import COLLECTED, PHASES, TRAIN, group_label
from headway.training.files import write_bytes
from headway.training.methods import METHODS

RAW_COLUMNS = [
    "env", "label", "seed", "group", "sim_params", "episodes", "return_mean", "return_std",
    "score", "run",
]  # fmt: skip

Cell = dict[str, Any]
Block = dict[str, Any]


@dataclasses.dataclass(frozen=True)
class Page:
    """Contents of all chapters."""

    found: tables.Runs
    looks: dict[str, dict[str, Any]]
    """Looks of the compared labels, in the order of the legend."""
    parts: pd.DataFrame
    """Final results by physics of the compared runs; `value` is the score where it is known for a
    whole environment, else the return."""
    scored: list[str]
    """Environments whose scores are known."""
    counter: Iterator[int] = dataclasses.field(default_factory=itertools.count)

    @classmethod
    def of(cls, found: tables.Runs) -> "Page":
        """Choose what is compared: all runs but references, or these if there are no others."""
        compared = found.runs[~found.runs.is_reference]
        order = compared.method.map({name: i for i, name in enumerate(METHODS)})
        by_method = compared.assign(order=order.fillna(len(METHODS)))
        labels = by_method.sort_values(["order", "method"], kind="stable").label.unique()
        looks = {
            str(label): {**figures.look(i), "gid": f"series-{i}"} for i, label in enumerate(labels)
        }
        final = found.final
        parts = tables.by_physics(final[final["run"].isin(compared["run"])])
        known = parts.groupby("env").score.agg(lambda scores: scores.notna().all())
        scored = [str(env) for env in known[known].index]
        parts["value"] = parts.score.where(parts.env.isin(scored), parts.return_mean)
        return cls(found, looks, parts, scored)

    @property
    def compared(self) -> pd.DataFrame:
        """The compared runs."""
        return self.found.runs[~self.found.runs.is_reference]

    @property
    def envs(self) -> list[str]:
        """Environments of the compared runs."""
        return sorted(self.compared.env.unique())

    def per_env(self, make: Callable[["Page", str], Block]) -> list[Block]:
        """A block for every environment."""
        return [{"title": env, **make(self, env)} for env in self.envs]

    def of_env(self, table: pd.DataFrame, env: str) -> pd.DataFrame:
        """Rows of compared runs in one environment."""
        return table[(table.env == env) & table["run"].isin(self.compared["run"])]

    def panel(
        self, title: str, draw: Callable[[Axes], None], label: str, **size: Any
    ) -> dict[str, Any]:
        """A figure with its title."""
        name = f"figure-{next(self.counter)}"
        return {"title": title, "svg": figures.panel(draw, name=name, label=label, **size)}

    def line(self, label: str, *cells: Cell, below: str = "") -> dict[str, Any]:
        """A line of a table; one of a compared label begins with its symbol, and hides with it."""
        series = list(self.looks).index(label) if label in self.looks else None
        first = {**_cell(label, below), "series": series}
        return {"series": series, "cells": [first, *cells]}


def write_report(runs: Sequence[str | Path], out: str | Path = "report.html") -> Path:
    """Compare runs on one page.

    Runs are grouped by environment, method and seed; variants of a method are told apart by the
    settings in which they differ. What is unfinished or damaged is named on the page.

    Args:
        runs: Run directories, or folders that hold some at any depth.
        out: The HTML file to write.

    Raises:
        RunError: A path is no directory, or holds no run that can be read.
        ConfigError: No run is named.
    """
    if not runs:
        raise ConfigError("no run is given, allowed: one or more run directories.")
    page = Page.of(tables.read_runs(runs))
    members = page.found.assignments
    heads = 1 + int(members["head"].max()) if len(members) else 1
    sections = [
        {"name": "results", "blocks": _results(page)},
        {"name": "learning-curves", "blocks": page.per_env(_curves)},
        {"name": "physics", "blocks": page.per_env(_physics)},
        {"name": "improvement", "blocks": [_improvement(page)]},
        {
            "name": "head-shares",
            "legend": [f"head {head}" for head in range(min(heads, len(figures.HEADS)))],
            "blocks": page.per_env(_head_shares),
        },
        {"name": "prediction-error", "blocks": page.per_env(_prediction_error)},
        {"name": "settings", "blocks": page.per_env(_settings)},
        {"name": "times", "blocks": page.per_env(_times)},
        {"name": "runs", "blocks": [_runs(page)]},
        {"name": "numbers", "blocks": [_numbers(page)]},
    ]
    environment = jinja2.Environment(
        loader=jinja2.PackageLoader("headway", "lab"),
        autoescape=True,
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )  # fmt: skip

    def symbol(label: str) -> Callable[[Axes], None]:
        """A piece of line with one marker."""

        def draw(axes: Axes) -> None:
            look = {**page.looks[label], "gid": None, "markersize": 5, "markevery": [1]}
            axes.plot([0, 1, 2], [0, 0, 0], **look)
            axes.set_axis_off()
            axes.margins(0.02, 0.5)

        return draw

    labels = list(page.looks)
    title = " and ".join(filter(None, [", ".join(labels[:-1]), labels[-1]]))
    text = environment.get_template("report.html.jinja").render(
        title=title if len(labels) <= 4 else f"{len(labels)} methods compared",
        envs=page.envs,
        count=len(page.compared),
        labels=labels,
        symbols=[page.panel("", symbol(i), "", size=(0.42, 0.16))["svg"] for i in labels],
        notes=page.found.notes,
        sections=sections,
        theme=figures.THEME,
        heads=len(figures.HEADS),
        version=headway.__version__,
        command=shlex.join(["headway", "report", *map(str, runs), "-o", str(out)]),
        svg=Markup,
    )
    write_bytes(Path(out), text.encode())
    return Path(out)


def _cell(text: str, *below: str, kind: str = "text") -> Cell:
    return {"text": text, "below": [text for text in below if text], "kind": kind}


def _number(value: float, form: str) -> str:
    return form.format(value).replace("-", "−")


def _estimate(found: statistics.Estimate | None, form: str = "{:.2f}", below: str = "") -> Cell:
    """A value with its interval below."""
    if found is None:
        return _cell("–", kind="number")
    ends = " to ".join(_number(end, form) for end in found.interval or ())
    return _cell(_number(found.value, form), ends, below, kind="number")


def _matrix(parts: pd.DataFrame, label: str, column: str) -> pd.DataFrame:
    """Means over physics of one label: a line per run, a column per group, training first."""
    own = parts[parts.label == label]
    matrix = own.groupby(["run", "group"], sort=False)[column].mean().unstack("group")
    return matrix[sorted(matrix.columns, key=lambda group: group != TRAIN)]


def _unlike(page: Page, env: str | None = None) -> list[str]:
    """Warn of numbers that stand beside each other but are of other tasks."""
    found = [
        f"{where}, {group}"
        for where, group in statistics.unlike(page.parts)
        if env == where or (env is None and group != TRAIN)
    ]
    text = "Not tested alike, so not compared: other physics, episode lengths or options in "
    return [f"{text}{'; '.join(found)}."] if found else []


def _results_of(page: Page, env: str) -> Block:
    own = page.of_env(page.parts, env)
    if own.empty:
        return {"texts": ["No run is finished yet."]}
    groups = sorted(own.group.unique(), key=lambda group: group != TRAIN)
    form = "{:.2f}" if env in page.scored else "{:,.1f}"
    lines = []
    for label in page.looks:
        if label not in set(own.label):
            continue
        values = _matrix(own, label, "value").reindex(columns=groups)
        returns = _matrix(own, label, "return_mean").reindex(columns=groups)
        cells = []
        for group in groups:
            column, below = values[[group]].dropna().to_numpy(), ""
            if env in page.scored and len(column):
                below = f"return {_number(returns[group].mean(), '{:,.0f}')}"
                below += f" ± {returns[group].std():,.0f}" if len(column) > 1 else ""
            cells.append(
                _estimate(statistics.estimate([column]) if len(column) else None, form, below)
            )
        seeds = f"{len(values)} seed{'s' * (len(values) != 1)}"
        lines.append(page.line(label, *cells, below=seeds))
    references = page.found.runs[page.found.runs.is_reference & (page.found.runs.env == env)]
    texts = ["Returns: no references are known for all of these physics."]
    if env in page.scored:
        own_runs = set(references.method) == set(tables.REFERENCES)
        by = "the runs of random and true-dynamics given here"
        texts = [f"Scores are normalised by {by if own_runs else 'the reference returns'}."]
    columns = ["method", *map(group_label, groups)]
    return {"table": {"columns": columns, "lines": lines}, "texts": texts + _unlike(page, env)}


def _results(page: Page) -> list[Block]:
    blocks = []
    if len(page.envs) > 1 and set(page.envs) == set(page.scored):
        unseen, lines = page.parts[page.parts.group != TRAIN], []
        for label in page.looks:
            own = [_matrix(unseen[unseen.env == env], label, "value") for env in page.envs]
            wanted = [set(unseen[unseen.env == env].group) for env in page.envs]
            whole = all(
                set(matrix) == groups and matrix.notna().all(axis=None) and len(matrix)
                for matrix, groups in zip(own, wanted, strict=True)
            )
            if whole:
                found = statistics.estimate([matrix.to_numpy() for matrix in own])
                lines.append(page.line(label, _estimate(found), below=f"{found.num_runs} seeds"))
        remarks = _unlike(page)
        columns = ["method", "score on unseen physics"]
        table = {"columns": columns, "lines": [] if remarks else lines}
        blocks.append({"title": "All environments", "table": table, "texts": remarks})
    counts = page.parts.groupby(["label", "env"], sort=False)["run"].nunique()
    few = [f"{label} on {env} ({n})" for (label, env), n in counts.items() if n < 3]  # type: ignore
    texts = [
        f"Fewer than {statistics.MIN_RUNS} finished seeds: {'; '.join(few)}. No interval is given"
        " for them, and no difference is claimed."
    ]
    narrow = [statistics.caution(min(counts))] if len(counts) else []
    return [*blocks, *page.per_env(_results_of), {"texts": texts * bool(few) + narrow}]


def _curves(page: Page, env: str) -> Block:
    own = page.of_env(page.found.curves, env)
    own = own.assign(finished=own["run"].isin(page.found.finished))
    references = page.found.final
    is_reference = page.found.runs.loc[page.found.runs.is_reference, "run"]
    levels = tables.by_group(references[references["run"].isin(is_reference)])
    panels, once = [], []
    for group, table in own.groupby("group", sort=False):
        if not table.duplicated("run").any():
            once.append(group_label(str(group)))
            continue
        here = levels[(levels.env == env) & (levels.group == group)]

        def draw(axes: Axes, table: pd.DataFrame = table, here: pd.DataFrame = here) -> None:
            figures.curves(axes, table, page.looks)
            for method, level in here.groupby("method").return_mean.mean().items():
                style = {"color": figures.FAINT, "fontsize": 7, "ha": "right", "va": "bottom"}
                axes.axhline(level, color=figures.FAINT, linewidth=1, linestyle=":")
                axes.text(0.995, level, str(method), transform=axes.get_yaxis_transform(), **style)

        label = f"Return over environment steps on {env}, {group}"
        panels.append((group != COLLECTED, page.panel(group_label(str(group)), draw, label)))
    panels.sort(key=lambda found: found[0])
    texts = [f"Measured after one iteration at most, so no curve: {'; '.join(once)}."]
    return {"panels": [panel for _, panel in panels], "texts": texts * bool(once)}


def _physics(page: Page, env: str) -> Block:
    own = page.of_env(page.parts, env)
    if own.empty:
        return {"texts": ["No run is finished yet."]}
    name = "score" if env in page.scored else "return per episode"
    shown = {label: look for label, look in page.looks.items() if label in set(own.label)}
    label = f"{name} by physics on {env}"
    physics = page.panel(
        f"{name} by physics",
        lambda axes: figures.by_physics(axes, own, shown, name, joined=True),
        label,
        size=(3.5, 2.9),
    )
    panels = [physics]
    for group in sorted(own.group.unique(), key=lambda group: group != TRAIN):
        values = own[own.group == group].groupby(["label", "run"]).value.mean().reset_index()
        panels.append(
            page.panel(
                group_label(group),
                lambda axes, values=values: figures.dots(axes, values, shown, name),
                f"{name} of each method on {env}, {group}",
                size=(3.5, 0.85 + 0.25 * len(shown)),
            )
        )
    return {"panels": panels}


def _improvement(page: Page) -> Block:
    unseen, labels = page.parts[page.parts.group != TRAIN], list(page.looks)
    found: dict[tuple[str, str], statistics.Estimate] = {}
    for first, second in itertools.combinations(labels, 2):
        shown = statistics.compare(unseen, first, second, "value")
        if shown is not None:
            ends = shown.interval and (1 - shown.interval[1], 1 - shown.interval[0])
            found[first, second] = shown
            found[second, first] = dataclasses.replace(shown, value=1 - shown.value, interval=ends)
    lines = [
        page.line(first, *(_estimate(found.get((first, second))) for second in labels))
        for first in labels
    ]
    claims = [
        statistics.verdict(one, other, shown)
        for (one, other), shown in found.items()
        if one == labels[0]
    ]
    block: Block = {
        "table": {"columns": ["", *labels], "lines": lines},
        "claims": claims,
        "texts": [statistics.caution(min(e.num_runs for e in found.values()))] if found else [],
    }
    if not found:
        one = "There is one method only: nothing to compare."
        none = "No two methods were tested on the same unseen physics."
        block = {"texts": [one if len(labels) == 1 else none]}
    return {**block, "texts": block["texts"] + _unlike(page)}


def _head_shares(page: Page, env: str) -> Block:
    panels = []
    for _, own in page.of_env(page.found.assignments, env).groupby("run", sort=False):
        if own["head"].nunique() > 1:
            title = f"{own.label.iloc[0]}, seed {own.seed.iloc[0]}"
            panels.append(
                page.panel(
                    title,
                    lambda axes, own=own: figures.head_shares(axes, own),
                    f"Head shares of {title} on {env}",
                    size=(3.5, 0.75 + 0.24 * own.sim_params.nunique()),
                )
            )
    return {"panels": panels, "texts": [] if panels else ["No method with several heads."]}


def _prediction_error(page: Page, env: str) -> Block:
    own = page.of_env(page.found.errors, env)
    own = own[np.isfinite(own.error)]
    groups = sorted(own.group.unique(), key=lambda group: group != TRAIN)
    panels = [
        page.panel(
            group_label(group),
            lambda axes, group=group: figures.error_lines(
                axes, own[own.group == group], page.looks
            ),
            f"Prediction error by imagined step on {env}, {group}",
        )
        for group in groups
    ]
    return {"panels": panels, "texts": [] if panels else ["No prediction errors."]}


def _settings(page: Page, env: str) -> Block:
    first = page.of_env(page.found.runs, env).drop_duplicates("label").set_index("label")["run"]
    settings = {label: page.found.settings[run] for label, run in first.items()}
    names = tables.differing(list(settings.values()), unless=("method", "seed"))
    lines = []
    for name in names:
        values = (_cell(tables.value_text(table.get(name))) for table in settings.values())
        lines.append({"series": None, "cells": [_cell(name, kind="code"), *values]})
    columns = ["setting", *map(str, settings)]
    texts = [] if names else ["All runs have the same settings."]
    return {"table": {"columns": columns, "lines": lines}, "texts": texts}


def _times(page: Page, env: str) -> Block:
    own = page.of_env(page.found.runs, env)
    own = own[own["run"].isin(page.found.finished)]
    means = own.groupby("label", sort=False)[list(PHASES)].mean()
    longest = max(means.sum(axis=1), default=0) or 1.0
    lines = []
    for label, minutes in means.iterrows():
        device = ", ".join(sorted(own.device[own.label == label].unique()))
        numbers = [_cell(f"{value:,.1f}", kind="number") for value in [*minutes, minutes.sum()]]
        bar = {**_cell("", kind="bar"), "widths": [100 * value / longest for value in minutes]}
        lines.append(page.line(str(label), *numbers, bar, _cell(device)))
    columns = ["method", *(f"{phase}, min" for phase in PHASES), "all, min", "", "device"]
    texts = [] if lines else ["No run is finished yet."]
    return {"table": {"columns": columns, "lines": lines}, "texts": texts}


def _runs(page: Page) -> Block:
    lines = []
    for run in page.found.runs.itertuples():
        label = f"{run.label} (reference)" if run.is_reference else str(run.label)
        done = _cell(f"{run.iterations} of {run.planned}", kind="number")
        seed = _cell(str(run.seed), kind="number")
        cells = (_cell(str(run.env)), seed, done, _cell(str(run.preset)))
        lines.append(page.line(label, *cells, _cell(str(run.run), kind="code")))
    columns = ["method", "environment", "seed", "iterations", "preset", "directory"]
    return {"table": {"columns": columns, "lines": lines}}


def _numbers(page: Page) -> Block:
    table = tables.by_physics(page.found.final)[RAW_COLUMNS].round(4)
    lines = []
    for row in table.itertuples(index=False):
        env, label, seed, group, physics, episodes, mean, std, score, _ = row
        numbers = [_number(value, "{:,.2f}") for value in (mean, std)]
        numbers.append("–" if np.isnan(score) else _number(score, "{:.3f}"))
        texts = [_cell(str(text)) for text in (env, seed, group, physics, episodes)]
        lines.append(page.line(label, *texts, *(_cell(text, kind="number") for text in numbers)))
    columns = [
        "method", "environment", "seed", "group", "physics", "episodes", "mean return",
        "standard deviation", "score",
    ]  # fmt: skip
    csv = table.rename(columns={"label": "method"}).to_csv(index=False)
    link = base64.b64encode(csv.encode()).decode()
    return {"table": {"columns": columns, "lines": lines}, "csv": link}
