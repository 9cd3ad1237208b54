"""Head selection and calibration of a trained run, as tables and as plain values."""

import dataclasses
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import jax
from rich.console import Group
from rich.jupyter import JupyterMixin
from rich.table import Table

from headway.config import Config
from headway.data import Trajectory
from headway.errors import ConfigError
from headway.lab.tables import distinct, full_label, group_label, new_table, varying
from headway.models.multi_headed import MultiHeadModel
from headway.task import sim_param_sets
from headway.training import selection
from headway.training.evaluate import evaluate, known_groups
from headway.training.methods import config_to_evaluate
from headway.training.progress import Progress
from headway.training.run import RunDir
from headway.training.trainers import load_agent


@dataclasses.dataclass(frozen=True)
class Diagnosis(JupyterMixin):
    """Head selection in a run's test episodes; notebooks and `rich.print` show its tables."""

    path: Path
    """The run directory."""
    config: Config
    """All settings."""
    episodes: dict[str, list[selection.EpisodeSelection]]
    """Predictions of all heads, by group and in the order of the episodes."""

    def __rich__(self) -> Group:
        """The tables that `headway diagnose` prints."""
        return Group(*tables(self))

    def summary(self, group: str) -> selection.SelectionSummary:
        """The averages of a group."""
        return selection.summarise(self.episodes[group])

    def by_physics(self, group: str) -> list[tuple[dict[str, float], selection.SelectionSummary]]:
        """The averages of each physics of a group, in ascending order."""
        found = []
        for physics in distinct(episode.sim_params for episode in self.episodes[group]):
            same = [e for e in self.episodes[group] if dict(e.sim_params) == physics]
            found.append((physics, selection.summarise(same)))
        return found


def diagnose(
    run_dir: str | Path,
    *,
    groups: Sequence[str] | None = None,
    num_episodes: int | None = None,
    settings: Mapping[str, Any] | None = None,
    progress: Progress | None = None,
) -> Diagnosis:
    """Examine head selection and predicted variances on a run's own test episodes.

    Before every step of them, all heads predict what it leads to. The episodes are those that the
    run was tested with after its last iteration. Where it kept none, or another number is
    asked for, tests are run with the run's protocol. Nothing in the directory changes.

    Args:
        run_dir: The run directory.
        groups: `"train"` or unseen groups; by default those that the run was tested with.
        num_episodes: Episodes per group to run tests with; by default those of the run are taken.
        settings: Changes of `planner` settings by dotted name: how heads would be selected, and
            learn, in these same episodes. Actions stay as they were, but for tests that are run.
        progress: Shown while testing; silent by default.

    Raises:
        RunError: There is no trained run, or it is damaged.
        UnknownNameError: No such group.
        ConfigError: A setting is unknown, of the wrong type or out of range, or one that training
            has fixed; or the run's method has no model with heads.
    """
    run = RunDir(run_dir)
    config = config_to_evaluate(run.config(), settings or {}, ("planner",))
    if config.model.kind != "multi-headed":
        raise ConfigError(
            f"{run.path} is a run of {config.method}, which has no prediction heads, allowed:"
            " methods with a multi-headed model, such as tmcl."
        )
    trajectories: Mapping[str, list[Trajectory]] = {}
    if num_episodes is None and (kept := run.tests()):
        wanted = known_groups(groups, sim_param_sets(config).group_names) if groups else [*kept]
        if kept.keys() >= set(wanted):
            trajectories = {group: kept[group] for group in wanted}
    if not trajectories:
        tested = evaluate(
            run_dir, groups=groups, num_episodes=num_episodes, settings=settings, progress=progress
        )
        config, trajectories = tested.config, tested.trajectories
    agent = load_agent(run, config)
    assert isinstance(agent.model, MultiHeadModel)
    key = jax.random.key(config.evaluation.seed)
    episodes = {
        group: selection.examine(agent.model, found, key=jax.random.fold_in(key, i))
        for i, (group, found) in enumerate(trajectories.items())
    }
    return Diagnosis(run.path, config, {group: found for group, found in episodes.items() if found})


def facts(diagnosis: Diagnosis) -> dict[str, Any]:
    """The diagnosis as plain values, for JSON."""

    def plain(summary: selection.SelectionSummary) -> dict[str, Any]:
        errors = {"head_errors": summary.head_errors.tolist(), "regret": summary.regret}
        return dataclasses.asdict(summary) | errors

    groups = []
    for group in diagnosis.episodes:
        physics = [{"sim_params": p, **plain(found)} for p, found in diagnosis.by_physics(group)]
        groups.append({"group": group, **plain(diagnosis.summary(group)), "physics": physics})
    return {"run_dir": str(diagnosis.path), "groups": groups}


def tables(diagnosis: Diagnosis) -> list[Table]:
    """Lay a diagnosis out: selection, errors of each head, calibration."""
    names = varying([e.sim_params for episodes in diagnosis.episodes.values() for e in episodes])
    groups = {group: diagnosis.summary(group) for group in diagnosis.episodes}
    numbers = ["episodes", "chosen", "best", "average", "regret", "wrong"]
    chosen = new_table(f"Head selection: {diagnosis.path}", "physics", numbers=numbers)
    count = max((summary.head_errors.shape[1] for summary in groups.values()), default=0)
    numbers = [*(f"head {head}" for head in range(count)), "best head"]
    heads = new_table("Error of each head", "physics", "member", numbers=numbers)
    numbers = ["mean square", *(f"inside {level:.0%}" for level in selection.LEVELS)]
    title = "Calibration of the predicted variance, chosen heads"
    calibration = new_table(title, "physics", numbers=numbers)
    for group, summary in groups.items():
        lines = [(group_label(group), summary)]
        for physics, found in diagnosis.by_physics(group):
            lines.append((f"  {full_label(physics, names)}", found))
        for name, found in lines:
            style = "bold" if found is summary else None
            errors = (found.chosen_error, found.best_error, found.average_error)
            relative = found.best_error and f"{found.regret / found.best_error:+.1%}"
            cells = [str(found.episodes), *(f"{error:.3g}" for error in errors), relative or "–"]
            chosen.add_row(name, *cells, f"{found.wrong_selections:.0%}", style=style)
            if found.calibration is not None:
                shares = [f"{found.calibration.inside[level]:.1%}" for level in selection.LEVELS]
                mean_square = f"{found.calibration.mean_square:.3g}"
                calibration.add_row(name, mean_square, *shares, style=style)
        for member, errors in enumerate(summary.head_errors):
            name = "" if member else group_label(group)
            cells = [f"{error:.3g}" for error in errors]
            heads.add_row(name, str(member), *cells, str(errors.argmin()))
        heads.add_section()
    chosen.caption = (
        "errors: mean squares in normalised units, of the chosen head, the best one of each episode"
        " in hindsight, and all heads; regret: chosen above best; wrong: chosen is not the best"
    )
    if diagnosis.config.planner.head_selection == "average":
        chosen.caption += ". This run plans with the average; chosen is what it would select."
    heads.caption = "mean squares in normalised units; head numbers of members are unrelated"
    calibration.caption = (
        "mean square: of the error in predicted standard deviations; 1 is right, more is too sure."
        " inside: share of the truth within the central interval of that level"
    )
    return [chosen, heads, *[calibration] * bool(calibration.row_count)]
