"""The chapters of the page that show how well methods do."""

import dataclasses
from collections.abc import Mapping, Sequence

from headway.report import statistics
from headway.report.page import charts, svg
from headway.report.page.measures import (
    TRAIN,
    aggregate,
    curve,
    curve_groups,
    groups,
    has_scores,
    improvements_of,
    outcomes,
    unlike,
    values,
)
from headway.report.page.parts import Block, Cell, Line, Panel, Section, Table, identifier
from headway.report.page.scoring import REFERENCES
from headway.report.page.series import Comparison, Series
from headway.report.statistics import Estimate
from headway.report.style import group_label


def results(comparison: Comparison) -> Section:
    """Tables of the final results."""
    lead = (
        "After the last iteration. Scores are 0 for random actions and 1 for a planner on"
        " the true dynamics; they are interquartile means over seeds with 95 % bootstrap intervals."
        " Returns are means ± standard deviations over seeds. Every physics of a group counts once."
    )
    blocks = [_all_environments(comparison)] if len(comparison.envs) > 1 else []
    blocks += [_results_of(comparison, env) for env in comparison.envs]
    blocks = [block for block in blocks if block is not None]
    return Section("results", "Results", lead, [*blocks, _seeds(comparison)])


def _all_environments(comparison: Comparison) -> Block | None:
    if remark := _unlike(comparison):
        return Block("All environments", texts=[remark])
    lines = []
    for series in comparison.series:
        found = aggregate(comparison, series)
        if found is not None:
            lines.append(Line([_named(series, found.num_runs), _estimate(found)], series.index))
    if not lines:
        return None
    table = Table(["method", "score on unseen physics"], lines)
    return Block("All environments", table=table)


def _results_of(comparison: Comparison, env: str) -> Block:
    tested = groups(comparison, env)
    lines = []
    for series in comparison.series_of(env):
        cells = [_result(comparison, env, series, group) for group in tested]
        seeds = len([run for run in comparison.runs_of(env, series) if run.tests])
        lines.append(Line([_named(series, seeds), *cells], series.index))
    columns = ["method", *map(group_label, tested)]
    if not tested:
        return Block(env, texts=["No run is finished yet."])
    texts = []
    if has_scores(comparison, env):
        texts.append(f"Scores are {comparison.references.describe(env)}.")
    else:
        texts.append("Returns: no references are known for all of these physics.")
    if remark := _unlike(comparison, env):
        texts.append(remark)
    return Block(env, table=Table(columns, lines), texts=texts)


def _unlike(comparison: Comparison, env: str | None = None) -> str:
    """Warn of numbers that stand beside each other but are of other tasks."""
    found = [
        (where, group)
        for where, group in unlike(comparison)
        if env == where or (env is None and group != TRAIN)
    ]
    if not found:
        return ""
    names = "; ".join(group if env else f"{where}, {group}" for where, group in found)
    return (
        "Not tested alike, so not compared: other physics, episode lengths or options of the"
        f" environment in {names}."
    )


def _result(comparison: Comparison, env: str, series: Series, group: str) -> Cell:
    found = outcomes(comparison, env, series, group)
    if not found:
        return Cell("–", is_number=True)
    with_score = has_scores(comparison, env)
    main = statistics.estimate([values(comparison, env, series, group)])
    cell = _estimate(main, "{:.2f}" if with_score else "{:,.1f}")
    if not with_score:
        return cell
    returns = [one.episode_return for one in found]
    spread = statistics.standard_deviation([returns])
    below = f"return {_number(float(statistics.mean([returns])), '{:,.0f}')}"
    below += "" if spread is None else f" ± {spread:,.0f}"
    return dataclasses.replace(cell, below=[*cell.below, below])


def _estimate(found: Estimate, form: str = "{:.2f}") -> Cell:
    """A value and its interval below."""
    ends = " to ".join(_number(end, form) for end in found.interval or ())
    return Cell(_number(found.value, form), [ends] if ends else [], is_number=True)


def _number(value: float, form: str) -> str:
    return form.format(value).replace("-", "−")


def _named(series: Series, seeds: int) -> Cell:
    return Cell(series.label, [f"{seeds} seed{'s' * (seeds != 1)}"], is_key=True)


def _seeds(comparison: Comparison) -> Block:
    """What the number of seeds allows to say."""
    counts = {
        (env, series.label): len([r for r in comparison.runs_of(env, series) if r.tests])
        for env in comparison.envs
        for series in comparison.series_of(env)
    }
    few = [place for place, number in counts.items() if number < statistics.MIN_RUNS]
    texts = []
    if few:
        names = "; ".join(f"{label} on {env} ({counts[env, label]})" for env, label in few)
        texts.append(
            f"Fewer than {statistics.MIN_RUNS} finished seeds: {names}. No interval is given for"
            " them, and no difference is claimed."
        )
    texts.append(statistics.caution(min(counts.values())))
    return Block(texts=[text for text in texts if text])


def learning(comparison: Comparison) -> Section:
    """Learning curves: while collecting, and of each tested group."""
    blocks = []
    for env in comparison.envs:
        panels, once = [], []
        for group in curve_groups(comparison, env):
            panel = _curves(comparison, env, group)
            panels += [panel] if panel else []
            once += [] if panel else [charts.group_title(group)]
        texts = [f"Measured after one iteration at most, so no curve: {'; '.join(once)}."]
        blocks.append(Block(env, panels, texts=texts if once else []))
    lead = (
        "Lines are means over seeds. Bands are 95 % bootstrap intervals of the mean; with fewer"
        " than three seeds each seed has a thin line instead. Dotted thin lines are unfinished"
        " runs. Every test episode counts once. The first iteration acts at random."
    )
    return Section("learning-curves", "Learning curves", lead, blocks)


def _curves(comparison: Comparison, env: str, group: str) -> Panel | None:
    found = [
        (series, measured)
        for series in comparison.series_of(env)
        if (measured := curve(comparison.runs_of(env, series), group)) is not None
    ]
    if not any(len(measured.steps) > 1 for _, measured in found):
        return None
    runs, references = comparison.runs_of(env), comparison.references
    known = {name: references.level(name, runs, group) for name in REFERENCES}
    levels = {name: level for name, level in known.items() if level is not None}
    title = charts.group_title(group)
    drawn = svg.panel(
        lambda axes: charts.learning_curves(axes, found, levels),
        name=identifier("learning", env, group),
        label=f"Return over environment steps on {env}, {title}",
    )
    return Panel(title, drawn)


def group_bars(comparison: Comparison) -> Section:
    """A bar per method for each group."""
    blocks = []
    for env in comparison.envs:
        panels = [
            panel
            for group in groups(comparison, env)
            if (panel := _bars(comparison, env, group)) is not None
        ]
        texts = [] if panels else ["No run is finished yet."]
        blocks.append(Block(env, panels, texts=texts))
    lead = (
        "Bars are means over seeds after the last iteration, dots single seeds, lines 95 %"
        " bootstrap intervals of the mean where there are three seeds or more."
    )
    return Section("groups", "Training and unseen physics", lead, blocks)


def _bars(comparison: Comparison, env: str, group: str) -> Panel | None:
    found = [
        (series, measured)
        for series in comparison.series_of(env)
        if (measured := values(comparison, env, series, group))
    ]
    if not found:
        return None
    with_score = has_scores(comparison, env)
    levels = {"true dynamics": 1.0} if with_score else None
    label = "score" if with_score else "return per episode"
    title = group_label(group)
    drawn = svg.panel(
        lambda axes: charts.group_bars(axes, found, label, levels),
        name=identifier("bars", env, group),
        label=f"{label} of each method on {env}, {title}",
        size=(3.5, _bars_height([series.label for series, _ in found])),
    )
    return Panel(title, drawn)


def _bars_height(labels: Sequence[str]) -> float:
    """Inches that leave the bars room above their names."""
    longest = min(max(map(len, labels)), charts.TICK_LETTERS)
    return (2.5 if len(labels) <= 4 else 2.9) + 0.03 * max(longest - 10, 0)


def improvements(comparison: Comparison) -> Section:
    """How likely one method beats another."""
    lead = (
        "Probability that a run of the method in the row beats a run of the method in the column on"
        " unseen physics, averaged over the environments and groups that both were tested on; 0.5"
        " means no difference. Below it the 95 % bootstrap interval."
    )
    series = comparison.series
    if len(series) < 2:
        blocks = [Block(texts=["There is one method only: nothing to compare."])]
        return Section("improvement", "Probability of improvement", lead, blocks)
    found = improvements_of(comparison)
    lines = []
    for first in series:
        cells = [_improvement(found.get((first.label, second.label))) for second in series]
        lines.append(Line([Cell(first.label, is_key=True), *cells], first.index))
    table = Table(["", *(one.label for one in series)], lines)
    first = series[0].label
    claims = [
        statistics.verdict(first, other, estimate)
        for (one, other), estimate in found.items()
        if one == first
    ]
    remarks = [text for text in (_caution(found), _unlike(comparison)) if text]
    block = Block(table=table, claims=claims, texts=remarks)
    if not found:
        texts = ["No two methods were tested on the same unseen physics."]
        block = Block(texts=[*texts, *remarks])
    return Section("improvement", "Probability of improvement", lead, [block])


def _caution(found: Mapping[tuple[str, str], statistics.Improvement]) -> str:
    counts = [one.num_runs for one in found.values()]
    return statistics.caution(min(counts)) if counts else ""


def _improvement(found: Estimate | None) -> Cell:
    if found is None:
        return Cell("–", is_number=True)
    return _estimate(found)
