"""One test episode over time: what was observed, what the model predicted, and with which heads."""

from collections.abc import Callable
from functools import partial
from pathlib import Path

import jax
import numpy as np
from matplotlib.axes import Axes

from headway.lab.tables import full_label, group_label
from headway.task import env_spec
from headway.training.diagnostics import imagine_from
from headway.training.run import RunDir
from headway.training.trainers import load_agent
from headway.worlds.rendering import HEADS

AHEAD = 5  # steps from one prediction to its moment
LONGEST, MOST = 200, 6  # steps and observed numbers that are legible
LOOKS = {
    "real": {"color": "C5", "alpha": 0.3, "linewidth": 3.4},
    "predicted one step before": {"color": "C0", "linewidth": 1.2},
    f"predicted {AHEAD} steps before": {"color": "C1", "linewidth": 1.2, "linestyle": "--"},
}
"""Lines of observed numbers, in the colours of the style in use."""


def follow_episode(run_dir: str | Path) -> tuple[str, dict[str, Callable[[Axes], None]]]:
    """Predict along the episode of median return of a run's last tests; nothing there changes.

    Returns:
        Which episode it is and how to read it; what draws its observed numbers, actions and heads
        over time, by title. Both are empty where a run learns nothing or kept no tests.

    Raises:
        HeadwayError: The run is damaged, or its environment or method is not known here.
    """
    run = RunDir(run_dir)
    kept = run.tests() if any(run.path.glob("tests/*")) else {}
    tests = [(t, group) for group, found in kept.items() for t in found if len(t) > AHEAD]
    if not tests or not (config := run.config()).model.learns:
        return "", {}
    episode, group = sorted(tests, key=lambda test: test[0].returns)[len(tests) // 2]
    model, key = load_agent(run, config).model, jax.random.key(config.evaluation.seed)
    assert model is not None
    steps = min(len(episode), LONGEST)
    starts = [(episode, start) for start in range(steps - AHEAD + 1)]
    imagined, heads = imagine_from(model, starts, AHEAD, key)
    predicted, chosen = np.asarray(imagined).mean(0), np.asarray([] if heads is None else heads)
    real, std = episode.obs[: steps + 1], episode.obs.std(0)
    scaled = (predicted[:, -1] - real[AHEAD:]) / np.where(std > 1e-6, std, np.inf)
    worst = np.argsort(-np.square(scaled).mean(0), kind="stable")[:MOST]
    names = dict(enumerate(env_spec(config.env).obs_names))

    def observed(axes: Axes, column: int) -> None:
        lines = real, predicted[:, 0], predicted[:, -1]
        for values, first, look in zip(lines, (0, 1, AHEAD), LOOKS.values(), strict=True):
            axes.plot(range(first, first + len(values)), values[:, column], **look)
            axes.set_ylim(axes.get_ylim())  # of the real ones, which come first
        axes.set(xlim=(0, steps), xlabel="step")

    def actions(axes: Axes) -> None:
        for i, values in enumerate(episode.action[:steps].T):
            axes.stairs(values, baseline=None, color=f"C{i}", linewidth=1)
        axes.set(xlim=(0, steps), xlabel="step")

    def of_members(axes: Axes) -> None:
        for member, row in enumerate(chosen.T):
            begins = np.flatnonzero(np.diff(row, prepend=-1))
            colors = [HEADS[head % len(HEADS)] for head in row[begins]]
            axes.barh(member, np.diff(begins, append=len(row)), 0.82, begins, color=colors)
        axes.set(xlim=(0, steps), xlabel="step", ylabel="member", yticks=range(len(chosen.T)))
        axes.invert_yaxis()

    panels: dict[str, Callable[[Axes], None]] = {}
    for i in np.sort(worst).tolist():
        panels[names.get(i, f"observation[{i}]")] = partial(observed, column=i)
    panels["actions, scaled to ±1"] = actions
    if chosen.any():
        panels["head of each member"] = of_members
    about = (
        f"The test episode of median return, {episode.returns:,.1f}: {group_label(group)},"
        f" {full_label(episode.sim_params, sorted(episode.sim_params))}. Shown are {steps} of its"
        f" {len(episode)} steps and, of {len(std)} observed numbers, the {len(worst)} predicted"
        " worst. From every step the model predicts, with what it has observed until then, where"
        " the episode's own actions lead: means over members, without noise."
    )
    return about, panels
