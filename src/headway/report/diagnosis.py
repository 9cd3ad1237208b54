"""How well a trained run selects heads and knows its own error, as tables and as plain values."""

import dataclasses
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import jax
from rich.table import Table

from headway.config import Config
from headway.data import Trajectory
from headway.errors import ConfigError
from headway.planning.agent import Agent
from headway.report.physics import distinct, full_label, varying
from headway.report.tables import new_table
from headway.task import sim_param_sets
from headway.training.evaluate import known_groups, run_tests
from headway.training.loading import load_agent
from headway.training.methods import config_to_evaluate
from headway.training.progress import Progress
from headway.training.run import RunDir
from headway.training.selection import (
    LEVELS,
    EpisodeSelection,
    SelectionSummary,
    examine,
    summarise,
)

Facts = dict[str, Any]

COLLECTED = "collected"


@dataclasses.dataclass(frozen=True)
class Diagnosis:
    """How heads were selected in a run's test episodes."""

    path: Path
    """The run directory."""
    config: Config
    """All settings."""
    episodes: dict[str, list[EpisodeSelection]]
    """What all heads predicted, by group and in the order of the episodes."""

    @property
    def window(self) -> int:
        """Right selections in a row after which selection has settled: as many as it looks at."""
        return self.config.planner.selection_length

    def summary(self, group: str) -> SelectionSummary:
        """The averages of a group."""
        return summarise(self.episodes[group], self.window)

    def by_physics(self, group: str) -> list[tuple[dict[str, float], SelectionSummary]]:
        """The averages of each physics of a group, in ascending order."""
        episodes = self.episodes[group]
        return [
            (
                physics,
                summarise([e for e in episodes if dict(e.sim_params) == physics], self.window),
            )
            for physics in distinct(episode.sim_params for episode in episodes)
        ]


def diagnose(
    run_dir: str | Path,
    *,
    groups: Sequence[str] | None = None,
    num_episodes: int | None = None,
    collected: bool = False,
    settings: Mapping[str, Any] | None = None,
    progress: Progress | None = None,
) -> Diagnosis:
    """Examine head selection and predicted variances on a run's own test episodes.

    Before every step of them, all heads predict what it leads to. The episodes are those that the
    run was tested with after its last iteration. Where it kept none, or another number is
    asked for, tests are run with the run's protocol. Nothing in the directory changes.

    Args:
        run_dir: The run directory.
        groups: `"train"` or unseen groups; all of them by default.
        num_episodes: Episodes per group to run tests with; by default those of the run are taken.
        collected: Take the episodes that the last iteration collected instead. The model has
            learned from these since.
        settings: Changes of `planner` settings by dotted name: how heads would be selected, and
            learn, in these same episodes. Actions stay as they were, but for tests that are run.
        progress: Shown while testing; silent by default.

    Raises:
        RunError: There is no trained run, or it is damaged.
        UnknownNameError: No such group.
        ConfigError: A setting is unknown, of the wrong type or out of range, or one that training
            has fixed; `collected` leaves no choice of groups and episodes; or the run's method
            has no model with heads.
    """
    run = RunDir(run_dir)
    _check_heads(run)
    config = config_to_evaluate(run.config(), settings or {}, ("planner",))
    if collected:
        return examined(run, config, _collected(run, groups, num_episodes))
    kept = run.tests() if num_episodes is None else {}
    if kept:
        wanted = known_groups(groups, sim_param_sets(config).group_names)
        if kept.keys() >= set(wanted):
            return examined(run, config, {group: kept[group] for group in wanted})
    tested = run_tests(
        run_dir, groups=groups, num_episodes=num_episodes, settings=settings, progress=progress
    )
    return examined(run, tested.config, tested.tests.trajectories)


def _check_heads(run: RunDir) -> None:
    if run.config().model.kind != "multi-headed":
        raise ConfigError(
            f"{run.path} is a run of {run.config().method}, which has no prediction heads, allowed:"
            " methods with a multi-headed model, such as tmcl."
        )


def _collected(
    run: RunDir, groups: Sequence[str] | None, num_episodes: int | None
) -> dict[str, list[Trajectory]]:
    if groups or num_episodes is not None:
        raise ConfigError(
            "groups or episodes are chosen together with `collected`, allowed: one of them; the"
            " collected episodes are all of training physics."
        )
    return {COLLECTED: run.iteration_data(run.last_iteration)}


def examined(
    run: RunDir, config: Config, trajectories: Mapping[str, list[Trajectory]]
) -> Diagnosis:
    """Examine what a run's heads predict of some episodes, and how they are selected.

    Args:
        run: The run, of a method with prediction heads.
        config: Its settings, with those of the planner perhaps changed.
        trajectories: Episodes of its environment, by group.

    Raises:
        RunError: There is no trained run, or it is damaged.
    """
    agent = load_agent(run, config)
    assert isinstance(agent, Agent)
    key = jax.random.key(config.evaluation.seed)
    episodes = {
        group: examine(agent, found, key=jax.random.fold_in(key, i))
        for i, (group, found) in enumerate(trajectories.items())
    }
    return Diagnosis(run.path, config, {group: found for group, found in episodes.items() if found})


def facts(diagnosis: Diagnosis) -> Facts:
    """The diagnosis as plain values, for JSON."""
    return {
        "run_dir": str(diagnosis.path),
        "settled_after": diagnosis.window,
        "groups": [
            {
                "group": group,
                **_summary(diagnosis.summary(group)),
                "physics": [
                    {"sim_params": physics, **_summary(summary)}
                    for physics, summary in diagnosis.by_physics(group)
                ],
            }
            for group in diagnosis.episodes
        ],
    }


def _summary(summary: SelectionSummary) -> Facts:
    calibration = summary.calibration
    return {
        "episodes": summary.episodes,
        "chosen_error": summary.chosen_error,
        "best_error": summary.best_error,
        "average_error": summary.average_error,
        "regret": summary.regret,
        "wrong_selections": summary.wrong,
        "settling_steps": summary.settling,
        "settled": summary.settled,
        "head_errors": summary.head_errors.tolist(),
        "calibration": None
        if calibration is None
        else {
            "mean_square": calibration.mean_square,
            "inside": {f"{level:g}": share for level, share in calibration.inside.items()},
        },
    }


def tables(diagnosis: Diagnosis) -> list[Table]:
    """Lay a diagnosis out: selection, errors of each head, calibration."""
    made = [_selection(diagnosis), _heads(diagnosis)]
    if any(diagnosis.summary(group).calibration for group in diagnosis.episodes):
        made.append(_calibration(diagnosis))
    return made


def _selection(diagnosis: Diagnosis) -> Table:
    table = new_table(f"Head selection: {diagnosis.path}", "physics")
    for name in ("episodes", "chosen", "best", "average", "regret", "wrong", "settles", "settled"):
        table.add_column(name, justify="right")
    for name, summary, style in _lines(diagnosis):
        table.add_row(
            name,
            str(summary.episodes),
            f"{summary.chosen_error:.3g}",
            f"{summary.best_error:.3g}",
            f"{summary.average_error:.3g}",
            _relative(summary),
            f"{summary.wrong:.0%}",
            "never" if summary.settling is None else f"{summary.settling:g}",
            f"{summary.settled:.0%}",
            style=style,
        )
    table.caption = (
        "errors: mean squares in normalised units, of the chosen head, the best one of each episode"
        " in hindsight, and all heads; regret: chosen above best; wrong: chosen is not the best;"
        f" settles: transitions seen before the best is chosen {diagnosis.window} times in a row"
        " (median); settled: share of episodes and members where that happens"
    )
    if diagnosis.config.planner.head_selection == "average":
        table.caption += ". This run plans with the average; chosen is what it would select."
    return table


def _relative(summary: SelectionSummary) -> str:
    if summary.best_error <= 0:
        return "–"
    return f"{summary.regret / summary.best_error:+.1%}"


def _heads(diagnosis: Diagnosis) -> Table:
    table = new_table("Error of each head", "physics", "member")
    summaries = {group: diagnosis.summary(group) for group in diagnosis.episodes}
    heads = max((s.head_errors.shape[1] for s in summaries.values()), default=0)
    for head in range(heads):
        table.add_column(f"head {head}", justify="right")
    table.add_column("best head", justify="right")
    for group, summary in summaries.items():
        for member, errors in enumerate(summary.head_errors):
            cells = [f"{error:.3g}" for error in errors]
            name = "" if member else _group(group)
            table.add_row(name, str(member), *cells, str(errors.argmin()))
        table.add_section()
    table.caption = "mean squares in normalised units; head numbers of members are unrelated"
    return table


def _calibration(diagnosis: Diagnosis) -> Table:
    table = new_table("Calibration of the predicted variance, chosen heads", "physics")
    table.add_column("mean square", justify="right")
    for level in LEVELS:
        table.add_column(f"inside {level:.0%}", justify="right")
    for name, summary, style in _lines(diagnosis):
        if summary.calibration is not None:
            shares = [f"{summary.calibration.inside[level]:.1%}" for level in LEVELS]
            table.add_row(name, f"{summary.calibration.mean_square:.3g}", *shares, style=style)
    table.caption = (
        "mean square: of the error in predicted standard deviations; 1 is right, more is too sure."
        " inside: share of the truth within the central interval of that level"
    )
    return table


def _lines(diagnosis: Diagnosis) -> list[tuple[str, SelectionSummary, str]]:
    """A line per group, then one per physics: name, averages, style."""
    lines = []
    everything = [e.sim_params for episodes in diagnosis.episodes.values() for e in episodes]
    names = varying(everything) if everything else []
    for group in diagnosis.episodes:
        lines.append((_group(group), diagnosis.summary(group), "bold"))
        for physics, summary in diagnosis.by_physics(group):
            lines.append((f"  {full_label(physics, names)}", summary, ""))
    return lines


def _group(group: str) -> str:
    names = {"train": "training", "unseen": "unseen", COLLECTED: "training, collected"}
    return names.get(group, f"unseen: {group}")
