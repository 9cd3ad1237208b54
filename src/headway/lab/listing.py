"""Tables of all names that the command line takes, and the runs of a comparison."""

from collections.abc import Mapping
from typing import Any

from rich.table import Table

from headway.config import Config, flatten, to_dict
from headway.lab.paper import EXPERIMENTS
from headway.lab.sweep import Comparison
from headway.lab.tables import axis_label, new_table, value_label, varying
from headway.task import EnvSpec, env_names, env_spec
from headway.training.methods import METHODS, PRESETS

Facts = dict[str, Any]


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


def _settings(settings: Mapping[str, Any]) -> str:
    return "\n".join(f"{name} {value}" for name, value in settings.items()) or "–"


def experiments() -> tuple[list[Facts], Table]:
    """Describe every experiment."""
    table = new_table("Experiments", "name", "what is compared", "arms")
    entries = []
    for found in EXPERIMENTS.values():
        arms = [
            {"label": arm.label, "method": arm.method, "settings": dict(arm.settings)}
            for arm in found.arms
        ]
        entries.append({"name": found.name, "title": found.title, "arms": arms})
        table.add_row(found.name, found.title, ", ".join(arm.label for arm in found.arms))
    table.caption = "headway reproduce NAME --envs pendulum --seeds 0:3 --preset quick"
    return entries, table


def states(comparison: Comparison) -> tuple[list[Facts], Table]:
    """Describe every run of a comparison and how far it is."""
    table = new_table(f"Runs of {comparison.experiment.name}", "run", "arms", "state")
    table.add_column("iterations", justify="right")
    entries, cells = [], comparison.cells
    for job in comparison.jobs:
        state, total = job.state, job.config.collection.num_iterations
        arms = [cell.arm for cell, other in cells.items() if other.path == job.path]
        facts = {"run_dir": str(job.path), "arms": arms, "state": state.name, "note": state.note}
        entries.append({**facts, "finished_iterations": state.iterations, "iterations": total})
        note = f"{state.name} {state.note}".rstrip()
        table.add_row(job.name, ", ".join(arms), note, f"{state.iterations}/{total}")
    missing = sum(one["state"] in ("missing", "begun") for one in entries)
    table.caption = f"{missing} of {len(entries)} runs are missing"
    return entries, table
