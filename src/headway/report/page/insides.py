"""The chapters of the page that look into the models: heads, contexts, predictions."""

import numpy as np

from headway.errors import HeadwayError
from headway.report.page import charts, contexts, svg
from headway.report.page.measures import TRAIN
from headway.report.page.parts import Block, Panel, Section, identifier
from headway.report.page.runs import LoadedRun, Row
from headway.report.page.series import Comparison
from headway.report.style import group_label

PARAGRAPH_RUNS = 8  # named one by one where something lacks


def head_shares(comparison: Comparison) -> Section:
    """Which head owns which physics, for every run with several heads."""
    blocks = []
    for env in comparison.envs:
        panels, without = [], []
        for run in comparison.runs_of(env):
            if len({row["head"] for row in run.head_shares}) > 1:
                panels.append(_shares(comparison, run))
            elif run.config.model.num_heads > 1:
                without.append(str(run.path))
        texts = [f"No head shares: {_listed(without)}."] if without else []
        if not panels and not without:
            texts = ["No method with several heads."]
        blocks.append(Block(env, panels, texts=texts))
    lead = (
        "Share of the collected segments of each physics that each head explains best, after the"
        " newest iteration: empty is none, full colour all. A row is a head of a member. Head"
        " numbers are arbitrary: head 0 of one member has nothing to do with head 0 of another."
    )
    return Section("head-shares", "Head shares", lead, blocks)


def _shares(comparison: Comparison, run: LoadedRun) -> Panel:
    rows = run.head_shares
    heads = len({(row["member"], row["head"]) for row in rows})
    drawn = svg.panel(
        lambda axes: charts.head_shares(axes, rows),
        name=identifier("heads", str(run.path)),
        label=f"Head shares of {run.path}",
        size=(2.5, 0.7 + 0.135 * heads),
    )
    return Panel(_title(comparison, run), drawn)


def context_maps(comparison: Comparison) -> Section:
    """What each run's context encoder makes of the physics."""
    blocks = []
    for env in comparison.envs:
        panels, texts, without = [], [], []
        for run in comparison.runs_of(env):
            try:
                found = contexts.embed(run)
            except (HeadwayError, OSError) as error:
                texts.append(f"{run.path} has no contexts to show: {error}")
                continue
            if found is None:
                without.append(_title(comparison, run))
            else:
                panels.append(_contexts(comparison, run, found))
        if without:
            texts.append(f"No learned context: {_listed(without)}.")
        blocks.append(Block(env, panels, texts=texts))
    lead = (
        f"Context vectors of {contexts.NUM_MOMENTS} moments of the collected episodes, as the first"
        " member's encoder sees them, on their two directions of greatest variance; colours are the"
        " true simulator parameters, which no model was told. Below: how much of the contexts'"
        " variance lies between physics, from 0 (says nothing) to 1 (tells them apart), for every"
        " member."
    )
    return Section("contexts", "Context embeddings", lead, blocks)


def _contexts(comparison: Comparison, run: LoadedRun, found: contexts.Embedding) -> Panel:
    drawn = svg.panel(
        lambda axes: charts.contexts(axes, found.points, found.physics, found.explained),
        name=identifier("contexts", str(run.path)),
        label=f"Context embeddings of {run.path}, coloured by simulator parameter",
        size=(3.5, 2.4),
    )
    shares = " ".join(f"{share:.2f}" for share in found.told_apart)
    return Panel(_title(comparison, run), drawn, f"between physics: {shares}")


def prediction_errors(comparison: Comparison) -> Section:
    """Error of imagined observations by the number of steps imagined."""
    blocks = []
    for env in comparison.envs:
        runs = comparison.runs_of(env)
        rows = [row for run in runs for row in run.prediction_errors]
        groups = dict.fromkeys(row["group"] for row in rows if np.isfinite(row["error"]))
        panels = [
            _errors(comparison, env, group)
            for group in sorted(groups, key=lambda group: group != TRAIN)
        ]
        without = [str(run.path) for run in runs if not run.prediction_errors]
        texts = [f"No prediction errors: {_listed(without)}."] if without else []
        blocks.append(Block(env, panels, texts=texts))
    lead = (
        "Root mean squared error of imagined observations on test episodes, in units of each"
        " dimension's standard deviation; at the dotted line predicting the mean would do as well."
        " Lines are means over seeds, bands reach from the best to the worst seed. Episodes are"
        " those of each run's own controller, so methods are measured where they went."
    )
    return Section("prediction-error", "Prediction error by horizon", lead, blocks)


def _errors(comparison: Comparison, env: str, group: str) -> Panel:
    lines = []
    for series in comparison.series_of(env):
        tables = [_of_group(run, group) for run in comparison.runs_of(env, series)]
        tables = [rows for rows in tables if rows]
        if tables:
            lines.append((series, tables))
    title = group_label(group)
    drawn = svg.panel(
        lambda axes: charts.prediction_error(axes, lines),
        name=identifier("error", env, group),
        label=f"Prediction error by imagined step on {env}, {title}",
    )
    return Panel(title, drawn)


def _of_group(run: LoadedRun, group: str) -> list[Row]:
    rows = [row for row in run.prediction_errors if row["group"] == group]
    return [row for row in rows if np.isfinite(row["error"])]


def _title(comparison: Comparison, run: LoadedRun) -> str:
    return f"{comparison.label_of(run)}, seed {run.config.seed}"


def _listed(names: list[str]) -> str:
    more = len(names) - PARAGRAPH_RUNS
    return "; ".join(names[:PARAGRAPH_RUNS]) + (f" and {more} more" if more > 0 else "")
