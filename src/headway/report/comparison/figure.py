"""The figure of an experiment: a panel per environment, a curve or a line of dots per arm."""

from collections.abc import Sequence
from pathlib import Path
from typing import Literal

import numpy as np
from jaxtyping import Float
from matplotlib.axes import Axes
from matplotlib.lines import Line2D
from matplotlib.ticker import MaxNLocator

from headway.experiment.methods import METHODS
from headway.report.comparison.runs import COLLECTED, Found, Point
from headway.report.comparison.scores import last_tests, unseen_scores
from headway.report.style import FAINT, INK, SERIES, figure, legend
from headway.sweeps.experiments import Arm
from headway.sweeps.jobs import Comparison

COLUMNS = 3
LineStyle = Literal["-", "--", ":"]
_STYLES: tuple[LineStyle, ...] = ("-", "--", ":")
_MAIN = ("tmcl", "mcl", "pets", "mh-pets", "pets-cadm", "grbal", "rebal", "ria")  # full lines


def draw_comparison(found: Found) -> list[Path]:
    """Draw returns over environment steps, or the last ones where only these were measured.

    Returns:
        The PNG and the SVG file; nothing where no run is finished.
    """
    comparison = found.comparison
    envs = [env for env in comparison.envs if any(point.env == env for point in found.points)]
    if not envs:
        return []
    path = comparison.folder / f"{comparison.experiment.name}.png"
    curves = has_curves(found)
    columns = 2 if len(envs) == 4 else min(len(envs), COLUMNS)
    lines = -(-len(envs) // columns)
    height = 2.6 if curves else 0.9 + 0.32 * len(comparison.experiment.arms)
    size = (max(3.6 * columns, 6.8), height * lines + (1.4 if curves else 1.1))
    look = {"title": _title(comparison), "caption": _caption(found, curves), "size": size}
    with figure(path, **look, svg=True, has_legend=curves) as drawing:
        panels = drawing.subplots(lines, columns, squeeze=False, sharey=not curves)
        for axes in panels.flat[len(envs) :]:
            axes.set_visible(False)
        for axes, env in zip(panels.flat, envs, strict=False):
            (_curves if curves else _dots)(axes, found, env)
            if len(comparison.envs) > 1:
                axes.set_title(env)
        if curves:
            for axes in panels[:, 0]:
                axes.set_ylabel(_measure(found).replace(", ", ",\n"))
            legend(drawing, _handles(found))
    return [path, path.with_suffix(".svg")]


def has_curves(found: Found) -> bool:
    """Whether some run was measured after several iterations."""
    runs = [(point.env, point.arm, point.seed) for point in found.points]
    return len(set(runs)) < len(runs)


def arm_styles(arms: Sequence[Arm]) -> dict[str, tuple[str, LineStyle]]:
    """A colour and a line style per arm; colours repeat with another style.

    Where arms are methods, a method looks the same in every figure.
    """
    places = range(len(arms))
    if are_methods(arms):
        order = [*_MAIN, *(name for name in METHODS if name not in _MAIN)]
        places = [order.index(arm.method) for arm in arms]
    return {
        arm.label: (SERIES[i % len(SERIES)], _STYLES[i // len(SERIES) % len(_STYLES)])
        for arm, i in zip(arms, places, strict=True)
    }


def are_methods(arms: Sequence[Arm]) -> bool:
    """Whether every arm is another method, and not a setting of one."""
    return len({arm.method for arm in arms}) == len(arms)


def seed_curves(
    points: Sequence[Point],
) -> tuple[Float[np.ndarray, " iteration"], Float[np.ndarray, "seed iteration"]]:
    """The curves of an arm, iteration by iteration: seeds differ in steps where an episode was cut.

    Args:
        points: What the runs of one arm measured in one environment.

    Returns:
        Environment steps, mean over seeds, and every seed's returns, at the iterations that all
        seeds were measured after.
    """
    runs: dict[int, dict[int, tuple[int, float]]] = {}
    for point in points:
        runs.setdefault(point.seed, {})[point.iteration] = point.timesteps, point.value
    if not runs:
        return np.zeros(0), np.zeros((0, 0))
    common = sorted(set.intersection(*(set(run) for run in runs.values())))
    table = np.array([[run[i] for i in common] for run in runs.values()]).reshape(len(runs), -1, 2)
    return table[..., 0].mean(0), table[..., 1]


def _title(comparison: Comparison) -> str:
    title = comparison.experiment.title
    env = f", {comparison.envs[0]}" if len(comparison.envs) == 1 else ""
    return f"{title[0].upper()}{title[1:]}{env}"


def _measure(found: Found) -> str:
    collected = found.comparison.experiment.measure == COLLECTED
    return f"return per episode, {'while collecting' if collected else 'unseen physics'}"


def _arms(found: Found) -> Sequence[Arm]:
    return found.comparison.experiment.arms


def _ordered(found: Found) -> list[str]:
    """Labels of arms: methods from the best to the worst over all environments, else as given."""
    arms = _arms(found)
    labels = [arm.label for arm in arms]
    if not are_methods(arms):
        return labels
    ranks = dict.fromkeys(labels, 0)
    for env in found.comparison.envs:
        means = {
            label: float(np.mean([point.value for point in found.last(env, label)] or [-np.inf]))
            for label in labels
        }
        for label in labels:
            ranks[label] += sum(mean > means[label] for mean in means.values())
    return sorted(labels, key=lambda label: ranks[label])


def _handles(found: Found) -> list[Line2D]:
    styles = arm_styles(_arms(found))
    return [
        Line2D([], [], color=color, linestyle=line, marker="o", markersize=4, label=label)
        for label, (color, line) in styles.items()
    ]


def _curves(axes: Axes, found: Found, env: str) -> None:
    """Mean over seeds, with a band of one standard deviation where there are several."""
    for label, (color, line) in arm_styles(_arms(found)).items():
        steps, returns = seed_curves(found.of(env, label))
        if not len(steps):
            continue
        mean = returns.mean(0)
        if not steps.any():  # nothing is learned
            axes.axhline(mean[0], color=color, linestyle=line, linewidth=1.2)
            continue
        if len(returns) > 1:
            std = returns.std(0, ddof=1)
            axes.fill_between(steps, mean - std, mean + std, color=color, alpha=0.13, linewidth=0)
        axes.plot(steps, mean, color=color, linestyle=line, marker="o", markersize=3)
    axes.set_xlim(left=0)
    axes.xaxis.set_major_locator(MaxNLocator(4))
    axes.xaxis.set_major_formatter("{x:,.0f}")
    axes.yaxis.set_major_formatter("{x:,.6g}")
    axes.set_xlabel("environment steps collected")


def _dots(axes: Axes, found: Found, env: str) -> None:
    """A line per arm: a dot per seed, a bar at their mean, the mean score beside it."""
    labels, styles = _ordered(found), arm_styles(_arms(found))
    place = axes.get_yaxis_transform()
    has_scores = False
    for row, label in enumerate(labels):
        values = [point.value for point in found.last(env, label)]
        if not values:
            axes.text(0.5, row, "no run", va="center", color=FAINT, transform=place)
            continue
        color = styles[label][0]
        axes.plot(values, [row] * len(values), "o", color=color, alpha=0.6, markersize=5)
        axes.plot([np.mean(values)] * 2, [row - 0.3, row + 0.3], color=INK, linewidth=1.6)
        scores = unseen_scores(last_tests(found, env, label)) if _is_scored(found) else []
        if scores:
            has_scores = True
            axes.text(1.02, row, f"{np.mean(scores):.2f}", va="center_baseline", transform=place)
    if has_scores:
        axes.text(1.02, -0.7, "score", va="center", color=FAINT, transform=place)
    axes.set_yticks(range(len(labels)), labels)
    axes.set_ylim(len(labels) - 0.5, -0.5)
    axes.tick_params(axis="y", length=0)
    axes.grid(visible=False, axis="y")
    axes.grid(visible=True, axis="x")
    axes.xaxis.set_major_locator(MaxNLocator(4))
    axes.xaxis.set_major_formatter("{x:,.6g}")
    axes.set_xlabel(_measure(found))


def _is_scored(found: Found) -> bool:
    return found.comparison.experiment.measure != COLLECTED


def _caption(found: Found, curves: bool) -> str:
    comparison = found.comparison
    what = "unseen physics"
    if comparison.experiment.measure == COLLECTED:
        what = "the episodes collected for training, the first iteration at random"
    seeds = comparison.seeds
    named = f"seed{'s' * (len(seeds) > 1)} {', '.join(map(str, seeds))}"
    if not curves:
        marks = "Dots are seeds after the last iteration, bars their mean."
        if _is_scored(found):
            marks += (
                " Scores, where known: 0 is random, 1 the paper's planner on the true dynamics."
            )
    elif len(seeds) > 1:
        marks = "Lines are means over seeds, bands ± 1 standard deviation."
    else:
        marks = "One run per line."
    missing = f" {len(found.missing)} runs are not finished." if found.missing else ""
    return f"Return on {what}; preset {comparison.preset}, {named}. {marks}{missing}"
