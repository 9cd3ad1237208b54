"""Tables and figures of this folder, made from its CSV files.

    python results/figures.py scores results/pendulum-quick
    python results/figures.py scores results/pendulum-quick --references results/ceilings
    python results/figures.py shares results/hopper-methods --references results/ceilings/hopper-200
    python results/figures.py returns results/cartpole-500-quick
    python results/figures.py arms results/adaptation/pendulum-quick NAME.png
    python results/figures.py changes results/adaptation/changes/pendulum NAME.png
    python results/figures.py planners results/planners/six.csv results/planners/six.png
    python results/figures.py learning results/half-cheetah-mass-1/pets.csv NAME.png
    python results/figures.py ceilings results/ceilings

Tables are printed as Markdown; a PNG file is drawn where one is named. `scores`, `shares` and
`returns` take a folder of METHOD/seed-N, `arms` and `changes` one table per run, `planners` and
`learning` one table.
"""

import argparse
import json
from pathlib import Path

import numpy as np
import pandas as pd

from headway.lab import figures
from headway.training.references import score
from headway.training.run import parse_sim_params

COLORS = (figures.FAINT, *figures.LABELS)
PLACE = ["group", "episode", "sim_params"]  # what two runs of the same test episode share


def markdown(table: pd.DataFrame) -> None:
    """Print a table, its index as the first columns."""
    flat = table.reset_index()
    heads = [" ".join(name) if isinstance(name, tuple) else name for name in flat.columns]
    for cells in [heads, ["---"] * len(heads), *flat.values.tolist()]:
        print("|", " | ".join(map(str, cells)), "|")


def each(values: pd.Series, digits: int = 2) -> str:
    """The value of every run."""
    return " ".join(f"{value:.{digits}f}" for value in values)


def last_tests(path: Path) -> pd.DataFrame:
    """Test episodes after the last iteration of a run."""
    table = pd.read_csv(path)
    return table[table.iteration == table.iteration.max()]


def kept_tests(folder: Path) -> pd.DataFrame:
    """Last test episodes of all runs in METHOD/seed-N of a folder."""
    tables = {
        (path.parts[-3], path.parts[-2]): last_tests(path)
        for path in sorted(folder.glob("*/seed-*/evaluation.csv"))
    }
    found = pd.concat(tables, names=["arm", "run"]).reset_index(["arm", "run"])
    found["physics"] = np.where(found.group == "train", "training", "unseen")
    return found


def scores(folder: Path, figure: Path | None, reference: Path | None) -> None:
    """Score of each run by method: 0 is random, 1 the paper's planner on the true dynamics.

    With `reference`, a folder of their tests, they are what both earned in the very episodes.
    """
    tests = kept_tests(folder)
    length = int(tests.length.max())
    if reference:
        for name in ("random", "true-dynamics"):
            their = last_tests(reference / f"{tests.env.iloc[0]}-{name}.csv")
            earned = their[[*PLACE, "return"]].rename(columns={"return": name})
            tests = tests.merge(earned, on=PLACE)
        keys = ["arm", "run", "physics", "sim_params"]
        means = tests.groupby(keys)[["return", "random", "true-dynamics"]].mean()
        means = means.sub(means["random"], axis=0)
        tests = (means["return"] / means["true-dynamics"]).rename("score").reset_index()
    else:
        tests["score"] = [
            score(env, parse_sim_params(physics), earned, length)
            for env, physics, earned in zip(
                tests.env, tests.sim_params, tests["return"], strict=True
            )
        ]
    by_run = tests.groupby(["arm", "physics", "run", "sim_params"]).score.mean()
    by_run = by_run.groupby(["arm", "physics", "run"]).mean()
    table = by_run.groupby(["arm", "physics"]).agg([each, lambda v: f"{v.mean():.2f}"])
    table.columns = ["each run", "mean"]
    order = by_run.xs("unseen", level="physics").groupby("arm").mean().sort_values(ascending=False)
    markdown(table.unstack("physics").swaplevel(axis=1).sort_index(axis=1).loc[order.index])


def shares(folder: Path, figure: Path | None, reference: Path | None) -> None:
    """Share of the way from random actions to the planner on the true dynamics, by run.

    It is the mean over training physics. `reference` begins the names of what both earned.
    """
    assert reference is not None
    tests = kept_tests(folder).query("physics == 'training'")
    tests["sim_params"] = tests.sim_params.str.replace("damping_scale=1 ", "")
    earned = tests.groupby(["arm", "run", "sim_params"])["return"].mean()
    random, ceiling = (
        pd.concat(map(pd.read_csv, reference.parent.glob(f"{reference.name}*-{name}.csv")))
        .groupby("sim_params")["return"]
        .mean()
        for name in ("random", "true-dynamics")
    )
    share = earned.sub(random, level="sim_params").div(ceiling - random, level="sim_params")
    by_run = share.groupby(["arm", "run"]).mean()
    table = by_run.groupby("arm").agg([each, lambda v: f"{v.mean():.2f}"])
    markdown(table.set_axis(["each run", "mean"], axis=1))


def returns(folder: Path, figure: Path | None, reference: Path | None) -> None:
    """Return of each run under each physics, by method."""
    tests = kept_tests(folder)
    by_run = tests.groupby(["arm", "physics", "sim_params", "run"])["return"].mean()
    table = by_run.groupby(["physics", "sim_params", "arm"]).agg(lambda v: each(v, 0))
    markdown(table.unstack("arm"))


def two_panels(
    table: pd.DataFrame, panels: list[str], value: str, figure: Path, title: str
) -> None:
    """Draw a row per method and a color per arm: a dot per run, a bar at the mean.

    Args:
        table: Columns method, arm, panel, run, value.
        panels: What is drawn on the left and on the right.
        value: Label of the horizontal axis.
        figure: The PNG file.
        title: Stands above.
    """
    counts = table.groupby("method").arm.nunique()
    table = table[table.method.isin(counts.index[counts > 1])]
    means = table[table.panel == panels[-1]].groupby(["method", "arm"])["value"].mean()
    methods = list(means.groupby("method").max().sort_values(ascending=False).index)
    shared = table.groupby("arm").method.nunique() == len(methods)
    arms = [arm for arm in table.arm.unique() if shared[arm]]
    looks = {arm: {"color": color} for arm, color in zip(arms, COLORS, strict=False)}
    names = {"none": "frozen heads", "last-layer": "heads that learn"}
    marks = {"marker": "o", "linestyle": ""}
    caption = (
        "A dot is one run, a bar the mean over runs. Same trained models and same episodes for"
        " all arms; no number was chosen on unseen physics."
    )
    with figures.figure(
        figure,
        title=title,
        caption=caption,
        size=(8.0, 1.9 + 0.45 * len(methods)),
        looks={names.get(arm, arm): {**looks[arm], **marks} for arm in arms},
    ) as drawing:
        for axes, panel in zip(drawing.subplots(1, 2, sharey=True), panels, strict=True):
            for row, method in enumerate(methods):
                for place, arm in enumerate(arms):
                    own = (table.method == method) & (table.arm == arm) & (table.panel == panel)
                    y, found = row + 0.2 * (place - (len(arms) - 1) / 2), table[own]["value"]
                    axes.plot(found, [y] * len(found), "o", ms=4, alpha=0.6, **looks[arm])
                    axes.plot(found.mean(), y, "|", ms=11, mew=2.5, **looks[arm])
            axes.set_yticks(range(len(methods)), methods)
            axes.set_ylim(len(methods) - 0.5, -0.5)
            figures.numbers(axes, x=value.format(panel))


def arms(folder: Path, figure: Path | None, reference: Path | None) -> None:
    """Score of trained runs with frozen heads and with heads that learn, by method."""
    table = pd.concat([pd.read_csv(path) for path in sorted(folder.glob("*.csv"))])
    table["panel"] = np.where(table.group == "train", "training", "unseen")
    runs = table.groupby(["method", "arm", "panel", "run"], sort=False).score.mean()
    cells = runs.groupby(["method", "arm", "panel"], sort=False).agg(
        lambda v: f"{each(v)} (mean {v.mean():.2f})"
    )
    markdown(cells.unstack("panel"))
    if figure:
        found = runs.rename("value").reset_index()
        title = "Heads that keep learning while they act, by method"
        two_panels(found, ["training", "unseen"], "score on {} physics", figure, title)


def changes(folder: Path, figure: Path | None, reference: Path | None) -> None:
    """Return after physics changed in the middle of an episode, and steps until recovery."""
    table = pd.concat([pd.read_csv(path) for path in sorted(folder.glob("*.csv"))])
    table["panel"] = np.where(table.over == 1, "a jump", "a drift")
    table["change"] = [
        ", ".join(
            f"{name} {json.loads(before)[name]:g} → {value:g}"
            for name, value in json.loads(after).items()
        )
        + (f" in {over} steps" if over > 1 else "")
        for before, after, over in zip(table.before, table.after, table.over, strict=True)
    ]
    cells = table.groupby(["method", "arm", "change"], sort=False).apply(
        lambda rows: f"{rows.return_after.mean():.0f} ({rows.recovery_steps.median():.0f})"
    )
    markdown(cells.unstack("change"))
    if figure:
        keys = ["method", "arm", "panel", "run"]
        found = table.groupby(keys, sort=False).return_after.mean().rename("value").reset_index()
        title = "Physics that change while acting"
        two_panels(found, ["a drift", "a jump"], "return after {}", figure, title)


def planners(path: Path, figure: Path | None, reference: Path | None) -> None:
    """Return of planners by the networks they evaluate per step, and their share of the paper's.

    The share is that of the way from random actions to the paper's planner, with the same models in
    the same episodes.
    """
    table = pd.read_csv(path)
    table["physics"] = np.where(table.group == "train", "training", "unseen")
    names = list(table.planner.unique())  # in the order they were tested
    by = {"index": ["env", "physics"], "columns": "planner", "sort": False}
    means = table.pivot_table(values="return", **by)[names]
    cost = table.pivot_table(values="network_evaluations_per_step", **by)
    random, paper = means["random actions"], means["paper"]
    share = means.sub(random, axis=0).div(paper - random, axis=0)
    shown = means.map("{:.0f}".format) + " (" + share.map("{:.0%}".format) + ")"
    markdown(shown.where(means.notna(), "–").T)
    if figure is None:
        return
    envs = list(dict.fromkeys(table.env))
    caption = (
        "Mean return with the same models in the same episodes. Filled and solid: training physics;"
        " hollow and dashed: unseen. Lines: 97 % of the way from random actions to the paper's."
    )
    title = "Return against networks evaluated per step"
    rows, columns = -(-len(envs) // 3), min(3, len(envs))
    size = 4.0 * columns + 2.5, 3.4 * rows + 0.6
    with figures.figure(figure, title=title, caption=caption, size=size) as drawing:
        panels = drawing.subplots(rows, columns, squeeze=False).flat
        for axes, env in zip(panels, envs, strict=False):
            for physics, style in (("training", "-"), ("unseen", "--")):
                low, high = means.loc[(env, physics), [names[0], "paper"]]
                axes.axhline(low + 0.97 * (high - low), color=figures.FAINT, lw=1.0, ls=style)
            for color, name in zip((*COLORS[1:], "k"), names[1:], strict=False):
                for physics, fill in (("training", "full"), ("unseen", "none")):
                    label = name if (env, physics) == (envs[0], "training") else None
                    style = {"color": color, "fillstyle": fill, "ls": "", "label": label}
                    place = (env, physics), name
                    axes.plot(cost.loc[place], means.loc[place], "o", ms=6, **style)
            axes.set_xscale("log")
            axes.set_title(env)
            figures.numbers(axes, y="return")
            axes.set_xlabel("network evaluations per step")
            axes.xaxis.set_major_formatter("{x:,.0f}")
        drawing.legend(loc="outside right center", fontsize=8)


def learning(path: Path, figure: Path | None, reference: Path | None) -> None:
    """Return of the episodes that were collected, by the environment steps before their end."""
    table = pd.read_csv(path)
    mean = table.groupby(["arm", "step"], sort=False)["return"].mean()
    last = mean.groupby("arm", sort=False).tail(5).groupby("arm", sort=False).mean()
    markdown(last.round(0).to_frame("mean return of the last five"))
    if figure is None:
        return
    title = f"Return while learning: {path.parent.name.replace('-', ' ')}"
    caption = "Each point is the mean of the episodes of one iteration; the first acts at random."
    with figures.figure(figure, title=title, caption=caption, size=(7.5, 4.2)) as drawing:
        axes = drawing.subplots()
        for color, (arm, found) in zip(COLORS[1:], mean.groupby("arm", sort=False), strict=False):
            axes.plot(found.index.get_level_values("step"), found, "o-", ms=3, c=color, label=arm)
        axes.legend(loc="upper left")
        figures.numbers(axes, y="return")
        axes.set_xlabel("environment steps")


def ceilings(folder: Path, figure: Path | None, reference: Path | None) -> None:
    """Mean and standard deviation of random actions and of the planner on the true dynamics."""
    for random in sorted(folder.glob("*-random.csv")):
        tables = [pd.read_csv(random), pd.read_csv(str(random).replace("random", "true-dynamics"))]
        found = pd.concat(tables).groupby(["sim_params", "method"])["return"]
        print(f"\n{random.name.removesuffix('-random.csv')}, {found.size().min()} episodes\n")
        markdown(found.agg(lambda v: f"{v.mean():.1f} ± {v.std(ddof=0):.1f}").unstack("method"))


def main() -> None:
    """Print a table; draw a figure where a file is named."""
    tables = (scores, shares, returns, arms, changes, planners, learning, ceilings)
    made = {table.__name__: table for table in tables}
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("what", choices=made)
    parser.add_argument("source", type=Path, help="folder or CSV file")
    parser.add_argument("figure", type=Path, nargs="?", help="PNG file to write")
    parser.add_argument("--references", type=Path, help="folder or file names' start")
    asked = parser.parse_args()
    made[asked.what](asked.source, asked.figure, asked.references)


if __name__ == "__main__":
    main()
