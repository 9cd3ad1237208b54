"""One page that compares runs and needs nothing else: no network, no script, no other file.

Its figures are Matplotlib's, inlined as SVG in the colours of the page's light or dark theme.
Everything that comes from a run is escaped, by Jinja or by Matplotlib.
"""

import base64
import dataclasses
import itertools
import shlex
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import jinja2
import numpy as np
import pandas as pd
from markupsafe import Markup
from matplotlib.axes import Axes
from rich.table import Table

import headway
from headway.errors import ConfigError, HeadwayError
from headway.lab import diagnose, episode, figures, statistics, tables
from headway.lab.tables import COLLECTED, PHASES, TRAIN, group_label
from headway.training.files import check_target, write_bytes
from headway.training.methods import REFERENCES

FILMS = {".gif": "image/gif", ".mp4": "video/mp4"}
ROOM = 16  # MiB of films on a page
RAW = {
    "label": "method", "env": "environment", "seed": "seed", "group": "group",
    "sim_params": "physics", "episodes": "episodes", "return_mean": "mean return",
    "return_std": "standard deviation", "score": "score",
}  # fmt: skip
"""Columns of the raw numbers, and what they are called on the page."""

Block = dict[str, Any]
Cell = str | tuple[str, ...]  # a text, and smaller ones below it


class Page:
    """Contents of all chapters. References are compared only where there are no other runs."""

    def __init__(self, found: tables.Runs):
        self.found = found
        self.runs = found.runs[~found.runs.is_reference]
        self.envs = sorted(self.runs.env.unique())
        labels = self.runs.sort_values(["order", "method"], kind="stable").label.unique()
        self.looks = {
            str(label): {**figures.look(i), "gid": f"series-{i}"} for i, label in enumerate(labels)
        }
        self.parts = tables.by_physics(found.final[found.final["run"].isin(self.runs["run"])])
        self.scored = {env for env, own in self.parts.groupby("env") if own.score.notna().all()}
        # The score where it is known for a whole environment, else the return.
        scored = self.parts.env.isin(self.scored)
        self.parts["value"] = self.parts.score.where(scored, self.parts.return_mean)
        self._numbers = itertools.count()

    def per_env(self, make: Callable[["Page", str], Block]) -> list[Block]:
        """A block for every environment."""
        return [{"title": env, **make(self, env)} for env in self.envs]

    def title(self, run: Any) -> str:
        """Name a run, a line of `runs`, for readers."""
        return ", ".join([run.label, f"seed {run.seed}", *[run.env] * (len(self.envs) > 1)])

    def of_env(self, table: pd.DataFrame, env: str) -> pd.DataFrame:
        """Rows of compared runs in one environment."""
        return table[(table.env == env) & table["run"].isin(self.runs["run"])]

    def panel(self, title: str, draw: Callable[[Axes], None], env: str, **size: Any) -> Block:
        """A figure with its title."""
        name, label = f"figure-{next(self._numbers)}", f"{title}, {env}"
        return {"title": title, "svg": figures.panel(draw, name=name, label=label, **size)}

    def line(self, label: str, *cells: Any, below: str = "") -> Block:
        """A line of a table; one of a compared label begins with its symbol, and hides with it."""
        series = list(self.looks).index(label) if label in self.looks else None
        return {"series": series, "cells": [(label, below), *cells]}


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
    check_target(Path(out))
    page = Page(tables.read_runs(runs))
    diagnoses, episodes = _examined(page)
    blocks = {
        "results": _results(page),
        "films": [_films(page)],
        "learning-curves": page.per_env(_curves),
        "physics": page.per_env(_physics),
        "improvement": [_improvement(page)],
        "head-shares": page.per_env(_head_shares),
        "diagnosis": diagnoses,
        "episode": episodes,
        "prediction-error": page.per_env(_prediction_error),
        "settings": page.per_env(_settings),
        "runs": [_runs(page)],
        "numbers": [_numbers(page)],
    }

    def filled(block: Block) -> bool:
        """Whether it holds more than remarks."""
        return bool(block.get("panels") or block.get("table", {}).get("lines"))

    def symbol(axes: Axes, look: dict[str, Any]) -> None:
        """Draw a piece of line with one marker."""
        axes.plot([0, 1, 2], [0, 0, 0], **{**look, "gid": None, "markersize": 5, "markevery": [1]})
        axes.set_axis_off()
        axes.margins(0.02, 0.5)

    text = render(
        "report.html.jinja",
        envs=page.envs,
        count=len(page.runs),
        labels=list(page.looks),
        symbols=[
            page.panel("", partial(symbol, look=look), "", size=(0.42, 0.16))["svg"]
            for look in page.looks.values()
        ],
        notes=page.found.notes,
        blocks={name: found for name, found in blocks.items() if any(map(filled, found))},
        heads=min(page.found.assignments["head"].nunique(), len(figures.HEADS)),
        theme=figures.THEME,
        version=headway.__version__,
        command=shlex.join(["headway", "report", *map(str, runs), "-o", str(out)]),
        svg=Markup,
    )
    write_bytes(Path(out), text.encode())
    return Path(out)


def render(template: str, **values: Any) -> str:
    """Fill in a template of this folder."""
    environment = jinja2.Environment(
        loader=jinja2.PackageLoader("headway", "lab"),
        autoescape=jinja2.select_autoescape(["html.jinja"]),
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
        keep_trailing_newline=True,
    )
    return environment.get_template(template).render(values)


def _number(value: float, form: str = "{:.2f}") -> str:
    return "–" if np.isnan(value) else form.format(value).replace("-", "−")


def _estimate(found: statistics.Estimate | None, form: str = "{:.2f}", below: str = "") -> Cell:
    """A value with its interval below."""
    if found is None:
        return "–"
    ends = " to ".join(_number(end, form) for end in found.interval or ())
    return _number(found.value, form), ends, below


def _table(columns: Sequence[str], lines: Sequence[Block], numbers: Sequence[int] = ()) -> Block:
    """A table; `numbers` are the places of columns that stand on the right."""
    return {"columns": columns, "lines": lines, "numbers": numbers}


def _groups(table: pd.DataFrame) -> list[str]:
    """Groups of physics, training first."""
    return sorted(table.group.unique(), key=lambda group: group != TRAIN)


def _matrix(parts: pd.DataFrame, label: str, column: str = "value") -> pd.DataFrame:
    """Means over physics of one label: a line per run, a column per group of any label."""
    own = parts[parts.label == label].groupby(["run", "group"], sort=False)[column].mean()
    return own.unstack("group").reindex(columns=_groups(parts))


def _mismatches(page: Page, env: str | None = None) -> list[str]:
    """Warn of numbers that stand beside each other but are of other tasks."""
    found = [
        f"{where}, {group}"
        for where, group in statistics.mismatches(page.parts)
        if env == where or (env is None and group != TRAIN)
    ]
    text = "Not tested alike, so not compared: other physics, episode lengths or options in "
    return [f"{text}{'; '.join(found)}."] if found else []


def _results_of(page: Page, env: str) -> Block:
    own = page.of_env(page.parts, env)
    if own.empty:
        return {}
    form = "{:.2f}" if env in page.scored else "{:,.1f}"
    lines = []
    for label in (label for label in page.looks if label in set(own.label)):
        values, returns = _matrix(own, label), _matrix(own, label, "return_mean")
        cells: list[Cell] = []
        for group in values:
            column, below = values[[group]].dropna().to_numpy(), ""
            if env in page.scored and len(column):
                below = f"return {_number(returns[group].mean(), '{:,.0f}')}"
                below += f" ± {returns[group].std():,.0f}" if len(column) > 1 else ""
            found = statistics.estimate([column]) if len(column) else None
            cells.append(_estimate(found, form, below))
        seeds = f"{len(values)} seed{'s' * (len(values) != 1)}"
        lines.append(page.line(label, *cells, below=seeds))
    references = page.found.runs[page.found.runs.is_reference & (page.found.runs.env == env)]
    text = "Returns: no references are known for all of these physics."
    if env in page.scored:
        own_runs = set(references.method) == set(REFERENCES)
        by = "the runs of random and true-dynamics given here"
        text = f"Scores are normalised by {by if own_runs else 'the reference returns'}."
    columns = ["method", *map(group_label, _groups(own))]
    table = _table(columns, lines, range(1, len(columns)))
    return {"table": table, "texts": [text, *_mismatches(page, env)]}


def _results(page: Page) -> list[Block]:
    blocks, remarks, lines = [], _mismatches(page), []
    if len(page.envs) > 1 and set(page.envs) == page.scored:
        unseen = page.parts[page.parts.group != TRAIN]
        for label in page.looks:
            own = [_matrix(unseen[unseen.env == env], label) for env in page.envs]
            if all(len(matrix) and matrix.notna().all(axis=None) for matrix in own):
                found = statistics.estimate([matrix.to_numpy() for matrix in own])
                lines.append(page.line(label, _estimate(found), below=f"{found.num_runs} seeds"))
        table = _table(["method", "score on unseen physics"], [] if remarks else lines, [1])
        blocks.append({"title": "All environments", "table": table, "texts": remarks})
    counts = page.parts.groupby(["label", "env"], sort=False)["run"].nunique()
    few = [f"{label} on {env} ({n})" for (label, env), n in counts.items() if n < 3]  # type: ignore
    texts = [statistics.caution(min(counts))] if len(counts) else []
    if few:
        text = f"Fewer than {statistics.MIN_RUNS} finished seeds: {'; '.join(few)}."
        texts.insert(0, f"{text} No interval is given for them, and no difference is claimed.")
    return [*blocks, *page.per_env(_results_of), {"texts": texts}]


def _curves(page: Page, env: str) -> Block:
    own = page.of_env(page.found.curves, env)
    own = own.assign(finished=own["run"].isin(page.found.finished))
    references = ~page.found.final["run"].isin(page.runs["run"])
    levels = tables.by_group(page.found.final[references & (page.found.final.env == env)])
    panels = []
    for group in sorted(own.group.unique(), key=lambda group: group != COLLECTED):
        table, here = own[own.group == group], levels[levels.group == group]
        if not table.duplicated("run").any():  # tested once is no curve
            continue

        def draw(axes: Axes, table: pd.DataFrame = table, here: pd.DataFrame = here) -> None:
            figures.curves(axes, table, page.looks)
            for method, level in here.groupby("method").return_mean.mean().items():
                style = {"color": figures.FAINT, "fontsize": 7, "ha": "right", "va": "bottom"}
                axes.axhline(level, color=figures.FAINT, linewidth=1, linestyle=":")
                axes.text(0.995, level, str(method), transform=axes.get_yaxis_transform(), **style)

        panels.append(page.panel(group_label(group), draw, env))
    return {"panels": panels}


def _physics(page: Page, env: str) -> Block:
    own = page.of_env(page.parts, env)
    shown = {label: look for label, look in page.looks.items() if label in set(own.label)}
    panels, names = [], ["score"] * (env in page.scored) + ["return per episode"]
    for name in names if shown else ():
        table = own if name == "score" else own.assign(value=own.return_mean)
        draw = partial(figures.by_physics, table=table, looks=shown, name=name)
        panels.append(page.panel(f"{name} by physics", draw, env, size=(3.7, 3.05)))
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
    if not found:
        return {}
    lines = [
        page.line(first, *(_estimate(found.get((first, second))) for second in labels))
        for first in labels
    ]
    pairs = [(*pair, shown) for pair, shown in found.items() if pair[0] == labels[0]]
    return {
        "table": _table(["", *labels], lines, range(1, len(labels) + 1)),
        "claims": [statistics.verdict(*pair) for pair in pairs],
        "texts": [statistics.caution(min(e.num_runs for e in found.values())), *_mismatches(page)],
    }


def _head_shares(page: Page, env: str) -> Block:
    panels = []
    for _, own in page.of_env(page.found.assignments, env).groupby("run", sort=False):
        if own["head"].nunique() > 1:
            title = f"{own.label.iloc[0]}, seed {own.seed.iloc[0]}"
            size = (3.7, 0.8 + 0.25 * own.sim_params.nunique())
            draw = partial(figures.head_shares, table=own)
            panels.append(page.panel(title, draw, env, size=size))
    return {"panels": panels}


def _examined(page: Page) -> tuple[list[Block], list[Block]]:
    """Diagnoses and episodes, of the first run of each label that kept its model and tests."""
    diagnoses, episodes = [], []
    for run in page.runs.drop_duplicates(["env", "label"]).itertuples():
        path, title = str(run.run), page.title(run)
        try:
            about, found = episode.follow_episode(path)
            panels = [page.panel(*panel, str(run.env), size=(3.7, 1.9)) for panel in found.items()]
            episodes.append({"title": title, "panels": panels, "texts": [about] * bool(about)})
            if about and page.found.settings[path].get("model.kind") == "multi-headed":
                shown = diagnose.tables(diagnose.diagnose(path))
                diagnoses += [_table_of(table, title) for table in shown]
        except HeadwayError as error:
            page.found.notes.append((path, f"no diagnosis: {error}"))
    return diagnoses, episodes


def _table_of(table: Table, owner: str) -> Block:
    """A table of the terminal, of a run."""
    rows = zip(*(column.cells for column in table.columns), strict=True)
    lines = [{"series": None, "cells": [c.replace("  ", "\u2003") for c in row]} for row in rows]
    numbers = [i for i, column in enumerate(table.columns) if column.justify == "right"]
    shown = _table([str(column.header) for column in table.columns], lines, numbers)
    title = f"{owner}: {str(table.title).partition(':')[0].lower()}"
    return {"title": title, "table": shown, "texts": [str(table.caption)]}


def _films(page: Page) -> Block:
    """The newest film of every run, as long as the page has room."""
    panels, room = [], ROOM * 2**20
    for run in page.runs.itertuples():
        films = [file for file in Path(str(run.run)).iterdir() if file.suffix.lower() in FILMS]
        for newest in sorted(films, key=lambda file: file.stat().st_mtime)[-1:]:
            if (size := newest.stat().st_size) > room:
                text = f"{newest.name} is left out: films on a page have {ROOM} MiB in all."
                page.found.notes.append((str(run.run), text))
                continue
            room -= size
            content = base64.b64encode(newest.read_bytes()).decode()
            kind = FILMS[newest.suffix.lower()]
            panels.append({"title": page.title(run), "film": f"data:{kind};base64,{content}"})
    return {"panels": panels}


def _prediction_error(page: Page, env: str) -> Block:
    own = page.of_env(page.found.errors, env)
    own, panels = own[np.isfinite(own.error)], []
    for group in _groups(own):
        draw = partial(figures.error_lines, table=own[own.group == group], looks=page.looks)
        panels.append(page.panel(group_label(group), draw, env))
    return {"panels": panels}


def _settings(page: Page, env: str) -> Block:
    first = page.of_env(page.runs, env).drop_duplicates("label").set_index("label")["run"]
    settings = {str(label): page.found.settings[run] for label, run in first.items()}
    lines = []
    for name in tables.differing(list(settings.values()), unless=("method", "seed")):
        values = (tables.value_text(table.get(name)) for table in settings.values())
        lines.append({"series": None, "cells": [name, *values]})
    return {"table": {**_table(["setting", *settings], lines), "code": 0}}


def _runs(page: Page) -> Block:
    lines = []
    for run in page.found.runs.itertuples():
        label = f"{run.label} (reference)" if run.is_reference else str(run.label)
        done = f"{run.iterations} of {run.planned}"
        minutes = (f"{getattr(run, phase):,.1f}" for phase in PHASES)
        cells = run.env, str(run.seed), done, *minutes, run.device, run.preset, run.run
        lines.append(page.line(label, *cells))
    times = [f"{phase}, min" for phase in PHASES]
    columns = ["environment", "seed", "iterations", *times, "device", "preset", "directory"]
    return {"table": {**_table(["method", *columns], lines, range(2, 7)), "code": 9}}


def _numbers(page: Page) -> Block:
    table = tables.by_physics(page.found.final)[[*RAW, "run"]].round(4)
    lines = []
    for label, *texts, mean, std, score, _ in table.itertuples(index=False):
        numbers = _number(mean, "{:,.2f}"), _number(std, "{:,.2f}"), _number(score, "{:.3f}")
        lines.append(page.line(label, *map(str, texts), *numbers))
    csv = table.rename(columns={"label": "method"}).to_csv(index=False)
    link = base64.b64encode(csv.encode()).decode()
    return {"table": _table([*RAW.values()], lines, range(6, 9)), "csv": link}
