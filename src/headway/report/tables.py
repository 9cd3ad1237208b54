"""Tables for people, and the same facts as plain values for programs."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from rich import box
from rich.table import Table
from rich.text import Text

from headway.config import Config, flatten, to_dict
from headway.report.physics import axis_label, distinct, full_label, value_label, varying
from headway.task import EnvSpec, env_names, env_spec
from headway.training.methods import METHODS, PRESETS
from headway.training.references import mean_score, score_of
from headway.training.run import EpisodeRow

Facts = dict[str, Any]


def by_physics(rows: Sequence[EpisodeRow], config: Config) -> list[Facts]:
    """Summarise test episodes for each group and its simulator parameters.

    Args:
        rows: Test episodes.
        config: Settings of the run, or runs, that were tested.

    Returns:
        Group, simulator parameters, number of episodes, mean and standard deviation of the
        return, and the mean score, which is None where no reference is known.
    """
    facts = []
    for group in dict.fromkeys(row.group for row in rows):
        for sim_params in distinct(row.sim_params for row in rows if row.group == group):
            same = [r for r in rows if r.group == group and dict(r.sim_params) == sim_params]
            facts.append(
                {
                    "group": group,
                    "sim_params": sim_params,
                    **_returns(same),
                    "score": mean_score([score_of(row, config) for row in same]),
                }
            )
    return facts


def by_group(rows: Sequence[EpisodeRow], config: Config) -> list[Facts]:
    """Summarise test episodes for each group; every physics of it counts once.

    The score is None unless a reference is known for every physics. The standard deviation is that
    of episodes.
    """
    parts = by_physics(rows, config)
    facts = []
    for group in dict.fromkeys(row.group for row in rows):
        same = [part for part in parts if part["group"] == group]
        score = mean_score([part["score"] for part in same])
        facts.append({"group": group, **_merged(same), "score": score})
    return facts


def evaluation(rows: Sequence[EpisodeRow], config: Config, title: str) -> Table:
    """Lay out the returns of test episodes: a line per group, then one per physics."""
    parts, groups = by_physics(rows, config), by_group(rows, config)
    with_score = any(part["score"] is not None for part in parts)
    table = new_table(title, "physics")
    for name in ("episodes", "return", *["score"] * with_score):
        table.add_column(name, justify="right")
    names = varying([row.sim_params for row in rows]) if rows else []
    for facts in groups:
        group = facts["group"]
        label = {"train": "training", "unseen": "unseen"}.get(group, f"unseen: {group}")
        table.add_row(label, *_cells(facts, with_score), style="bold")
        for part in parts:
            if part["group"] == group:
                physics = f"  {full_label(part['sim_params'], names)}"
                table.add_row(physics, *_cells(part, with_score))
        table.add_section()
    table.caption = (
        "return: mean ± standard deviation over episodes; every physics of a group counts once"
    )
    if with_score:
        table.caption += "; score: 0 = random actions, 1 = the paper's planner on the true dynamics"
    return table


def envs() -> tuple[list[Facts], Table]:
    """Describe every environment."""
    specs = [env_spec(name) for name in env_names()]
    table = new_table("Environments", "name", "what varies", "training", "unseen")
    for name in ("obs", "action", "steps"):
        table.add_column(name, justify="right")
    table.add_column("options", overflow="fold")
    table.columns[0].no_wrap = True
    entries = [_env(spec) for spec in specs]
    for spec, entry in zip(specs, entries, strict=True):
        everything = [p for part in entry["sim_params"].values() for p in part]
        names = varying(everything)
        train, *unseen = (
            ", ".join(value_label(sim_params, names) for sim_params in part)
            for part in entry["sim_params"].values()
        )
        sizes = (entry["obs_size"], entry["action_size"], entry["episode_length"])
        table.add_row(
            spec.name,
            axis_label(names),
            train,
            "\n".join(unseen),
            *map(str, sizes),
            "\n".join(entry["options"]) or "–",
        )
    return entries, table


def methods() -> tuple[list[Facts], Table]:
    """Describe every method."""
    table = new_table("Methods", "name", "description", "settings that differ from tmcl")
    entries, usual = [], flatten(to_dict(Config(env="pendulum")))
    for method in METHODS.values():
        # What is the same in the paper's preset is set because another preset changes it.
        chosen = {
            name: value
            for name, value in flatten(method.settings).items()
            if value != usual.get(name)
        }
        entries.append(
            {
                "name": method.name,
                "description": method.description,
                "settings": chosen,
            }
        )
        table.add_row(method.name, method.description, _settings(chosen))
    return entries, table


def presets() -> tuple[list[Facts], Table]:
    """Describe every preset."""
    table = new_table("Presets", "name", "description")
    entries = []
    for preset in PRESETS.values():
        entries.append({"name": preset.name, "description": preset.description})
        table.add_row(preset.name, preset.description)
    return entries, table


def _env(spec: EnvSpec) -> Facts:
    task = spec.make_task(**spec.options)
    sets = spec.sim_params
    return {
        "name": spec.name,
        "id": spec.env_id,
        "description": spec.description,
        "obs_size": task.obs_size,
        "action_size": task.action_size,
        "episode_length": spec.episode_length,
        "sim_params": {
            group: [dict(sim_params) for sim_params in sets.group(group)]
            for group in sets.group_names
        },
        "options": dict(spec.options),
    }


def _returns(rows: Sequence[EpisodeRow]) -> Facts:
    returns = np.array([row.episode_return for row in rows])
    return {
        "episodes": len(rows),
        "return_mean": float(returns.mean()),
        "return_std": float(returns.std()),
    }


def _merged(parts: Sequence[Facts]) -> Facts:
    """The returns of several physics as one, whatever the number of their episodes."""
    means = np.array([part["return_mean"] for part in parts])
    variances = np.array([part["return_std"] for part in parts]) ** 2
    return {
        "episodes": sum(part["episodes"] for part in parts),
        "return_mean": float(means.mean()),
        "return_std": float(np.sqrt((variances + (means - means.mean()) ** 2).mean())),
    }


def _cells(facts: Facts, with_score: bool) -> list[str]:
    spread = f" ± {facts['return_std']:,.1f}" if facts["episodes"] > 1 else ""
    cells = [str(facts["episodes"]), f"{facts['return_mean']:,.1f}{spread}"]
    if with_score:
        cells.append("–" if facts["score"] is None else f"{facts['score']:.2f}")
    return cells


def _settings(settings: Mapping[str, Any]) -> str:
    return "\n".join(f"{name} {value}" for name, value in settings.items()) or "–"


class TextTable(Table):
    """A table whose texts are shown as they are: what is in brackets is no markup."""

    def add_row(self, *cells: Any, **look: Any) -> None:
        """Add a line of cells; strings are plain text."""
        plain = [Text(cell) if isinstance(cell, str) else cell for cell in cells]
        super().add_row(*plain, **look)


def new_table(title: str, *columns: str) -> TextTable:
    """An empty table in the look of all others; its texts are shown as they are."""
    table = TextTable(
        *columns,
        title=Text(title, "bold"),
        title_justify="left",
        caption_justify="left",
        box=box.SIMPLE_HEAD,
    )
    table.caption_style = "dim"
    return table
