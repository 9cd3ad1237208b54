"""The figures of a run, drawn from the files in its directory alone."""

from collections import Counter
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.patches import Patch
from matplotlib.ticker import MaxNLocator

from headway.config import Config
from headway.report.physics import axis_label, distinct, value_label, varying
from headway.report.style import (
    FAINT,
    HEADS,
    INK,
    TRAINING,
    figure,
    group_colors,
    group_label,
    label_axis,
    legend,
)
from headway.training.references import score_of
from headway.training.run import EpisodeRow, RunDir, parse_sim_params

Row = dict[str, Any]


def save_run_figures(run_dir: str | Path) -> list[Path]:
    """Draw every figure that the files of a run allow.

    Args:
        run_dir: A run directory; the PNG files go into its `figures/`.

    Returns:
        The files written, in reading order. A figure whose numbers are missing is left out.

    Raises:
        RunError: There is no run, or a file of it is damaged.
    """
    run = RunDir(run_dir)
    config = run.config()
    drawn = [draw(run, config) for draw in _FIGURES]
    return [path for path in drawn if path is not None]


def learning_curve(run: RunDir, config: Config) -> Path | None:
    """Draw the returns over environment steps (supplement, Fig. 9)."""
    metrics = run.metrics()
    if not metrics or "collection" not in metrics[0]:  # nothing was learned
        return None
    path = run.figures / "learning_curve.png"
    episodes = len(metrics[0]["collection"]["returns"])
    caption = (
        f"{_source(config)}. Mean over episodes, band and bars ± 1 standard deviation."
        f" {episodes} episodes per iteration collected;"
        f" {_tested(run.evaluation())}. The first iteration acts at random; tests follow the fit."
    )
    with figure(path, title="Return while learning", caption=caption, size=(6.8, 4.3)) as drawing:
        axes = drawing.subplots()
        _collected(axes, metrics)
        groups = list(dict.fromkeys(g for row in metrics for g in row.get("evaluation") or {}))
        colors = group_colors(groups)
        for group in groups:
            _tested_curve(axes, metrics, group, colors[group])
        axes.set_xlim(left=0)
        axes.xaxis.set_major_locator(MaxNLocator(6))
        axes.xaxis.set_major_formatter("{x:,.0f}")
        axes.yaxis.set_major_formatter("{x:,.0f}")
        label_axis(axes, "environment steps collected", "return per episode (sum of rewards)")
        legend(drawing)
    return path


def _collected(axes: Axes, metrics: list[Row]) -> None:
    """The training return of each iteration's collection."""
    steps = np.array([row["timesteps"] for row in metrics])
    mean = np.array([row["collection"]["return_mean"] for row in metrics])
    std = np.array([row["collection"]["return_std"] for row in metrics])
    axes.fill_between(steps, mean - std, mean + std, color=TRAINING, alpha=0.15, linewidth=0)
    label = "training, collected"
    axes.plot(steps, mean, color=TRAINING, marker="o", markersize=4, label=label)


def _tested_curve(axes: Axes, metrics: list[Row], group: str, color: str) -> None:
    """The return of one group's tests."""
    tested = [row for row in metrics if group in (row.get("evaluation") or {})]
    values = [row["evaluation"][group] for row in tested]
    axes.errorbar(
        [row["timesteps"] for row in tested],
        [value["return_mean"] for value in values],
        yerr=[value["return_std"] for value in values],
        color=color,
        marker="D" if group == "train" else "s",
        markersize=5,
        elinewidth=1,
        linestyle="--" if group == "train" else "-",
        markerfacecolor="white" if group == "train" else color,
        label="training, tested" if group == "train" else group_label(group),
    )


def head_shares(run: RunDir, config: Config) -> Path | None:
    """Draw which head owns which physics, one panel per member, after the last iteration."""
    rows = _last_iteration(run.assignments())
    if not rows or config.model.num_heads < 2:
        return None
    path = run.figures / "head_shares.png"
    members = sorted({row["member"] for row in rows})
    columns = min(len(members), 5)
    lines = -(-len(members) // columns)
    caption = (
        f"{_source(config)}, iteration {rows[0]['iteration'] + 1}. Share of the collected segments"
        " whose oracle loss is lowest under each head. Head numbers are arbitrary: head 0 of one"
        " member has nothing to do with head 0 of another."
    )
    size = (max(1.75 * columns + 0.6, 5.6), 2.35 * lines + 1.1)
    title = "Which head owns which physics"
    with figure(path, title=title, caption=caption, size=size) as drawing:
        panels = drawing.subplots(lines, columns, sharey=True, squeeze=False)
        for axes in panels.flat[len(members) :]:
            axes.set_visible(False)
        for axes, member in zip(panels.flat, members, strict=False):
            _stacked_shares(axes, [row for row in rows if row["member"] == member])
            axes.set_title(f"member {member}")
        for axes in panels[:, 0]:
            axes.set_ylabel("share of segments")
        handles = [
            Patch(color=HEADS[head % len(HEADS)], label=f"head {head}")
            for head in sorted({row["head"] for row in rows})
        ]
        legend(drawing, handles)
    return path


def _stacked_shares(axes: Axes, rows: list[Row]) -> None:
    """One bar per physics, split among the heads."""
    physics = distinct(parse_sim_params(row["sim_params"]) for row in rows)
    shares = {(row["head"], row["sim_params"]): row["share"] for row in rows}
    by_text = {text: parse_sim_params(text) for text in {row["sim_params"] for row in rows}}
    texts = sorted(by_text, key=lambda text: physics.index(by_text[text]))
    bottom = np.zeros(len(texts))
    for head in sorted({row["head"] for row in rows}):
        heights = np.array([shares.get((head, text), 0.0) for text in texts])
        color = HEADS[head % len(HEADS)]
        axes.bar(range(len(texts)), heights, 0.8, bottom, color=color, edgecolor="white")
        bottom += heights
    names = varying(physics)
    axes.set_xlabel(axis_label(names))
    axes.set_xticks(range(len(texts)), [value_label(by_text[text], names) for text in texts])
    axes.tick_params(axis="x", length=0)
    axes.set_yticks([0, 0.5, 1], ["0", "50 %", "100 %"])
    axes.set_ylim(0, 1)
    axes.grid(visible=False)


def prediction_error(run: RunDir, config: Config) -> Path | None:
    """Draw how the model's predictions drift with the length of imagination."""
    rows = [row for row in _last_iteration(run.prediction_errors()) if np.isfinite(row["error"])]
    if not rows:
        return None
    path = run.figures / "prediction_error.png"
    caption = (
        f"{_source(config)}, iteration {rows[0]['iteration'] + 1}. Root mean squared error of"
        " imagined observations over moments of test episodes, members and dimensions, in units"
        " of each dimension's standard deviation. At 1, predicting the mean would do as well."
    )
    title = "Prediction error by imagined step"
    with figure(path, title=title, caption=caption, size=(6.8, 4.1)) as drawing:
        axes = drawing.subplots()
        groups = list(dict.fromkeys(row["group"] for row in rows))
        for group, color in group_colors(groups).items():
            chosen = [row for row in rows if row["group"] == group]
            steps, errors = zip(*[(row["step"], row["error"]) for row in chosen], strict=True)
            axes.plot(steps, errors, color=color, label=group_label(group), marker="o", ms=3)
        axes.axhline(1.0, zorder=1, color=FAINT, linewidth=1, linestyle=":")
        errors = np.array([row["error"] for row in rows])
        if errors.max() > 10:
            axes.set_yscale("log")
        else:
            axes.set_ylim(0, max(1.1, 1.05 * errors.max()))
        axes.set_xlim(0.5, max(row["step"] for row in rows) + 0.5)
        axes.xaxis.set_major_locator(MaxNLocator(8, integer=True))
        label_axis(axes, "imagined steps ahead", "error (standard deviations)")
        legend(drawing)
    return path


def evaluation(run: RunDir, config: Config) -> Path | None:
    """Draw the last test's return, and its score where known, for each physics."""
    rows = _last_tests(run.evaluation())
    if not rows:
        return None
    path = run.figures / "evaluation.png"
    returns = [row.episode_return for row in rows]
    panels: list[tuple[str, Sequence[float | None]]] = [("return per episode", returns)]
    scores = [score_of(row, config) for row in rows]
    if any(value is not None for value in scores):
        panels.append(("score (0 random, 1 true dynamics)", scores))
    caption = (
        f"{_source(config)}, iteration {rows[0].iteration + 1}. Dots are episodes, bars their"
        f" mean. {_tested(rows)}."
    )
    size = (0.8 + 4.4 * len(panels) if len(panels) > 1 else 6.8, 4.1)
    title = "Return on training and unseen physics"
    with figure(path, title=title, caption=caption, size=size) as drawing:
        for axes, (label, values) in zip(
            drawing.subplots(1, len(panels), squeeze=False)[0], panels, strict=True
        ):
            _by_physics(axes, rows, values, label)
        if len(panels) > 1:
            for level in (0.0, 1.0):
                drawing.axes[1].axhline(level, color=FAINT, linewidth=1, linestyle=":")
        legend(drawing)
    return path


def _by_physics(
    axes: Axes, rows: list[EpisodeRow], values: Sequence[float | None], label: str
) -> None:
    """A column per physics, in ascending order; unseen ones stand on a grey ground."""
    physics = distinct(row.sim_params for row in rows)
    columns = [physics.index(dict(row.sim_params)) for row in rows]
    rng = np.random.default_rng(0)
    groups = list(dict.fromkeys(row.group for row in rows))
    for group, color in group_colors(groups).items():
        found = [
            (column, value)
            for row, column, value in zip(rows, columns, values, strict=True)
            if row.group == group and value is not None
        ]
        if not found:
            continue
        x, y = np.array(found).T
        jitter = rng.uniform(-0.13, 0.13, len(x))
        axes.scatter(
            x + jitter, y, s=18, color=color, alpha=0.55, linewidths=0, label=group_label(group)
        )
        means = [(column, y[x == column].mean()) for column in np.unique(x)]
        for column, mean in means:
            axes.plot([column - 0.3, column + 0.3], [mean, mean], color=color, linewidth=2.6)
    for column in {c for row, c in zip(rows, columns, strict=True) if row.group != "train"}:
        axes.axvspan(column - 0.5, column + 0.5, color="#f4f4f4", zorder=0, linewidth=0)
    names = varying(physics)
    axes.yaxis.set_major_formatter("{x:,.10g}")
    axes.set_xticks(range(len(physics)), [value_label(p, names) for p in physics], color=INK)
    axes.set_xlim(-0.5, len(physics) - 0.5)
    axes.tick_params(axis="x", length=0)
    label_axis(axes, axis_label(names), label)


def _source(config: Config) -> str:
    return f"{config.env}, {config.method}, preset {config.preset}, seed {config.seed}"


def _tested(rows: list[EpisodeRow]) -> str:
    """How many episodes the last test had, for example `8 test episodes per group`."""
    counts = Counter(row.group for row in _last_tests(rows))
    if not counts:
        return "no test episodes"
    if len(set(counts.values())) == 1:
        return f"{next(iter(counts.values()))} test episodes per group"
    return "test episodes: " + ", ".join(f"{group} {n}" for group, n in sorted(counts.items()))


def _last_tests(rows: list[EpisodeRow]) -> list[EpisodeRow]:
    last = max((row.iteration for row in rows), default=None)
    return [row for row in rows if row.iteration == last]


def _last_iteration(rows: list[Row]) -> list[Row]:
    last = max((row["iteration"] for row in rows), default=None)
    return [row for row in rows if row["iteration"] == last]


_FIGURES: tuple[Callable[[RunDir, Config], Path | None], ...] = (
    learning_curve,
    evaluation,
    head_shares,
    prediction_error,
)
