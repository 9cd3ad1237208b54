"""One tidy table of any number of runs, with scores, and its terminal form.

Reads run directories and the tables kept in `results/`, whose settings may be of an older shape:
only what is needed is read, and damage costs one line.
"""

import dataclasses
import json
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from rich import box
from rich.table import Table
from rich.text import Text

from headway.config import Config
from headway.errors import RunError
from headway.task import env_names, env_spec
from headway.training.methods import METHODS
from headway.training.references import score, score_of
from headway.training.run import EpisodeRow, parse_sim_params

REFERENCES = ("random", "true-dynamics")
TRAIN, COLLECTED = "train", "collected"
PHASES = ("collect", "fit", "evaluate")
UNITS = {"length": "m", "mass": "kg"}
SERIES = ["env", "label", "seed", "run"]  # the keys of a run in every table

_COLUMNS: dict[str, dict[str, type]] = {
    "evaluation.csv": {
        "iteration": int, "group": str, "sim_params": str, "episode": int, "return": float,
    },
    "assignments.csv": {
        "iteration": int, "member": int, "head": int, "sim_params": str, "share": float,
    },
    "prediction_error.csv": {"iteration": int, "group": str, "step": int, "error": float},
}  # fmt: skip
_DAMAGE = (OSError, ValueError, KeyError, TypeError, AttributeError, ArithmeticError)
_NO_VARIANT = ("env", "method", "preset", "seed", "collection.max_bad_episodes")
_LONG_LABEL = 60  # letters

Physics = Mapping[str, float]


@dataclasses.dataclass(frozen=True)
class Runs:
    """Tables of some runs; each line names its run by the columns `SERIES`."""

    runs: pd.DataFrame
    """A line per run: method, preset, protocol, iterations, planned, device, minutes by phase."""
    episodes: pd.DataFrame
    """Test episodes: iteration, group, sim_params, episode, return, score (NaN: unknown)."""
    curves: pd.DataFrame
    """Mean and std of returns by iteration, timesteps and group; `collected` while collecting."""
    collected: pd.DataFrame
    """Episodes collected for training: iteration, group, episode, return."""
    assignments: pd.DataFrame
    """Rows of `assignments.csv` after the newest iteration."""
    errors: pd.DataFrame
    """Rows of `prediction_error.csv` after the newest tested iteration."""
    settings: Mapping[str, Mapping[str, Any]]
    """Settings by dotted name, by run."""
    notes: Sequence[tuple[str, str]]
    """Remarks on runs: path of the run, one line."""

    @property
    def finished(self) -> pd.Series:
        """Paths of the runs with every iteration done."""
        return self.runs.loc[self.runs.iterations >= self.runs.planned, "run"]

    @property
    def final(self) -> pd.DataFrame:
        """Test episodes after the last iteration of finished runs."""
        last = self.runs[["run", "planned"]].drop_duplicates().set_index("run")["planned"]
        found = self.episodes[self.episodes["run"].isin(self.finished)]
        return found[found.iteration == found["run"].map(last) - 1]


def find_runs(paths: Iterable[str | Path]) -> list[Path]:
    """List run directories at or below some paths.

    Raises:
        RunError: A path is no directory, or holds no run.
    """
    found: dict[Path, None] = {}
    for path in map(Path, paths):
        if not path.is_dir():
            raise RunError(f"{path} is not a directory, allowed: run directories or folders.")
        here = [path] if (path / "config.json").exists() else []
        below = here or sorted(file.parent for file in path.rglob("config.json"))
        if not below:
            raise RunError(f"{path} holds no run, allowed: run directories or folders of them.")
        found |= dict.fromkeys(below)
    return list(found)


def read_runs(paths: Iterable[str | Path]) -> Runs:
    """Read runs; whatever is damaged or unfinished is noted in one line.

    A run that stands at two places counts once. Variants of a method in an environment are labelled
    by the settings in which they differ.

    Args:
        paths: Run directories, or folders that hold some at any depth.

    Raises:
        RunError: A path is no directory, or nothing there is a run that can be read.
    """
    notes: list[tuple[str, str]] = []
    found = find_runs(paths)
    read = [run for path in found if (run := _read_run(path, notes)) is not None]
    if not read:
        raise RunError(f"none of {len(found)} runs can be read: {notes[0][1]}")
    order = [*METHODS, *sorted({run["facts"]["method"] for run in read} - {*METHODS})]
    read.sort(
        key=lambda run: (
            run["facts"]["env"],
            order.index(run["facts"]["method"]),
            run["facts"]["seed"],
            -run["facts"]["iterations"],
            run["facts"]["run"],
        )
    )
    kept: dict[str, dict[str, Any]] = {}
    for run in read:
        name = json.dumps({k: v for k, v in run["settings"].items() if k != _NO_VARIANT[-1]})
        first = kept.setdefault(name, run)
        if first is not run:
            same = f"left out: same settings and seed as {first['facts']['run']}."
            notes.append((run["facts"]["run"], same))
    settings = {run["facts"]["run"]: run["settings"] for run in kept.values()}
    runs = pd.DataFrame([run["facts"] for run in kept.values()])
    runs["label"] = _labels(runs, settings)
    runs = runs.sort_values("env", kind="stable", ignore_index=True)
    names = runs[[*SERIES, "method", "protocol"]]

    def together(name: str) -> pd.DataFrame:
        tables = pd.concat([run[name] for run in kept.values()], ignore_index=True)
        return names.merge(tables, on="run")

    episodes = together("episodes")
    made = Runs(
        runs, episodes, together("curves"), together("collected"), together("assignments"),
        together("errors"), settings, notes,
    )  # fmt: skip
    episodes["score"] = _scores(made)
    return made


def _read_run(path: Path, notes: list[tuple[str, str]]) -> dict[str, Any] | None:
    def attempt(read: Callable[[], Any], instead: Any, lost: str) -> Any:
        try:
            return read()
        except _DAMAGE as error:
            reason = f"{type(error).__name__} {error}".splitlines()[0]
            notes.append((str(path), f"{lost}: {reason[:200]}"))
            return instead

    def table(name: str, lost: str) -> pd.DataFrame:
        empty = pd.DataFrame({c: pd.Series(dtype=kind) for c, kind in _COLUMNS[name].items()})
        return attempt(lambda: _read_table(path / name), empty, lost).assign(run=str(path))

    def read_config() -> tuple[dict[str, Any], dict[str, Any]]:
        content = json.loads((path / "config.json").read_bytes())
        config = _flatten(content.get("config", content))
        return config, {
            "run": str(path),
            "env": str(config["env"]),
            "method": str(config["method"]),
            "preset": str(config.get("preset", "?")),
            "seed": int(config["seed"]),
            "device": str(content.get("device", "?")),
            "protocol": _protocol(config),
        }

    settings, facts = attempt(read_config, (None, None), "left out")
    if facts is None:
        return None
    nothing = pd.DataFrame(columns=["iteration", "group"])
    lines, curves, collected = attempt(
        lambda: _read_metrics(path / "metrics.jsonl"),
        ([], nothing, nothing),
        "no curve, times or final result",
    )
    planned = int(settings.get("collection.num_iterations", len(lines)))
    minutes = {p: sum(line["seconds"].get(p, 0.0) for line in lines) / 60 for p in PHASES}
    facts |= {"iterations": len(lines), "planned": planned, **minutes}
    episodes = table("evaluation.csv", "no final result")
    if len(lines) < planned:
        done = f"{len(lines)} of {planned} iterations are finished"
        notes.append((str(path), f"{done}: it is in the curves, not in the final results."))
    elif planned - 1 not in set(episodes.iteration):
        notes.append((str(path), "no test episodes after the last iteration: no final result."))
    return {
        "facts": facts,
        "settings": settings,
        "episodes": episodes,
        "curves": curves.assign(run=str(path)),
        "collected": collected.assign(run=str(path)),
        "assignments": _newest(table("assignments.csv", "no head shares")),
        "errors": _newest(table("prediction_error.csv", "no prediction errors")),
    }


def _read_table(path: Path) -> pd.DataFrame:
    columns = _COLUMNS[path.name]
    if not path.exists():
        return pd.DataFrame({name: pd.Series(dtype=kind) for name, kind in columns.items()})
    missing = {name: ["nan"] for name in ("share", "error")}
    kinds: Any = columns
    table = pd.read_csv(path, dtype=kinds, keep_default_na=False, na_values=missing)[list(columns)]
    if "return" in table and not np.isfinite(table["return"]).all():
        raise ValueError(f"{path.name} holds a return that is no finite number")
    for text in table.get("sim_params", pd.Series(dtype=str)).unique():
        parse_sim_params(text)
    return table


def _read_metrics(path: Path) -> tuple[list[dict[str, Any]], pd.DataFrame, pd.DataFrame]:
    """Lines of `metrics.jsonl`, with their rows of `Runs.curves` and `Runs.collected`."""
    lines = [json.loads(line) for line in path.read_text().splitlines()] if path.exists() else []
    curves, collected = [], []
    for line in lines:
        line.setdefault("seconds", {})
        when, summaries = int(line["iteration"]), dict(line.get("evaluation", {}))
        if line.get("collection"):
            summaries[COLLECTED] = line["collection"]
            returns = enumerate(map(float, line["collection"]["returns"]))
            collected += [(when, COLLECTED, episode, value) for episode, value in returns]
        for group, summary in summaries.items():
            numbers = (float(summary["return_mean"]), float(summary["return_std"]))
            curves.append((when, int(line["timesteps"]), group, *numbers))
    return (
        lines,
        pd.DataFrame(curves, columns=["iteration", "timesteps", "group", "return", "std"]),
        pd.DataFrame(collected, columns=["iteration", "group", "episode", "return"]),
    )


def _newest(table: pd.DataFrame) -> pd.DataFrame:
    return table[table.iteration == table.iteration.max()]


def _flatten(table: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    """Settings by dotted name; physics and options of the environment stay whole."""
    found = {}
    for name, value in table.items():
        nested = isinstance(value, dict) and name not in ("sim_params", "env_options")
        found |= _flatten(value, f"{prefix}{name}.") if nested else {f"{prefix}{name}": value}
    return found


def _protocol(settings: Mapping[str, Any]) -> str:
    """Length of an episode and options of the environment: only alike tests are compared."""
    length, options = settings.get("collection.episode_length"), settings.get("env_options") or {}
    if settings["env"] in env_names():
        spec = env_spec(settings["env"])
        length, options = length or spec.episode_length, {**spec.options, **options}
    return json.dumps([length, options], sort_keys=True)


def _labels(runs: pd.DataFrame, settings: Mapping[str, Mapping[str, Any]]) -> list[str]:
    """Name runs by method, and variants of it by what differs beside environment and seed.

    What follows from the preset is not named beside it.
    """
    names: dict[str, dict[str, None]] = {method: {} for method in runs.method}
    for (method, _), same in runs.groupby(["method", "env"]):
        presets = [[settings[run] for run in part["run"]] for _, part in same.groupby("preset")]
        if len(presets) > 1:
            names[str(method)]["preset"] = None
        for tables in presets:
            names[str(method)] |= dict.fromkeys(differing(tables))
    labels: list[str] = []
    numbers: dict[str, dict[str, int]] = {}
    for method, run in zip(runs.method, runs["run"], strict=True):
        variant = [
            f"{name.rpartition('.')[2].replace('_', ' ')} {value_text(settings[run].get(name))}"
            for name in names[method]
        ]
        label = ", ".join([method, *variant])
        number = numbers.setdefault(method, {}).setdefault(label, len(numbers[method]) + 1)
        labels.append(label if len(label) <= _LONG_LABEL else f"{method}, variant {number}")
    return labels


def differing(tables: Sequence[Mapping[str, Any]], unless: Sequence[str] = _NO_VARIANT) -> list:
    """Names of the settings that some tables disagree on; one that lacks a name abstains."""
    names = dict.fromkeys(name for table in tables for name in table if name not in unless)
    given = {name: [table[name] for table in tables if name in table] for name in names}
    return [name for name, values in given.items() if any(v != values[0] for v in values)]


def value_text(value: Any) -> str:
    """Write a setting's value for readers."""
    if isinstance(value, bool):
        return "on" if value else "off"
    if isinstance(value, list):
        return " ".join(map(value_text, value))
    text = f"{value:.7g}" if isinstance(value, float) else str("–" if value is None else value)
    return text.replace("-", "−") if isinstance(value, int | float) else text


def _scores(found: Runs) -> list[float]:
    """Score every episode between random actions (0) and a planner on the true dynamics (1).

    Runs of both references come first, every seed counting once; else the project's own
    reference returns. References that planned in several ways are compared like methods.
    """
    variants = found.runs.groupby(["env", "method"])["label"].nunique()
    single = {key for key in variants[variants == 1].index if key[1] in REFERENCES}
    found.runs["is_reference"] = [key in single for key in found.runs[["env", "method"]].itertuples(
        index=False, name=None)]  # fmt: skip
    if found.runs.is_reference.all():
        found.runs["is_reference"] = False
    place = ["method", "env", "protocol", "sim_params"]
    levels = found.final.groupby([*place, "run"])["return"].mean().groupby(place).mean().to_dict()
    scores = []
    for row in found.episodes[[*place[1:], "return"]].itertuples(index=False, name=None):
        env, protocol, sim_params, value = row
        low, high = (
            levels.get((method, env, protocol, sim_params)) if (env, method) in single else None
            for method in REFERENCES
        )
        if low is None or high is None or low == high:
            length, options = json.loads(protocol)
            known = env in env_names() and options == dict(env_spec(env).options)
            own = score(env, parse_sim_params(sim_params), value, length) if known else None
            scores.append(np.nan if own is None else own)
        else:
            scores.append((value - low) / (high - low))
    return scores


def by_physics(episodes: pd.DataFrame) -> pd.DataFrame:
    """Summarise test episodes by run, group and simulator parameters.

    Returns:
        Columns `SERIES`, group, sim_params, protocol; episodes, return_mean, return_std (over
        episodes), and score, NaN unless it is known for all of them.
    """
    keys = [*SERIES, "method", "protocol", "group", "sim_params"]
    return episodes.groupby(keys, sort=False, as_index=False).agg(
        episodes=("return", "size"),
        return_mean=("return", "mean"),
        return_std=("return", lambda returns: returns.std(ddof=0)),
        score=("score", lambda scores: scores.mean(skipna=False)),
    )


def by_group(episodes: pd.DataFrame) -> pd.DataFrame:
    """Summarise test episodes by run and group; every physics of a group counts once."""
    parts = by_physics(episodes)
    keys = [*SERIES, "method", "protocol", "group"]
    parts["square"] = parts.return_std**2 + parts.return_mean**2
    table = parts.groupby(keys, sort=False, as_index=False).agg(
        episodes=("episodes", "sum"),
        return_mean=("return_mean", "mean"),
        square=("square", "mean"),
        score=("score", lambda scores: scores.mean(skipna=False)),
    )
    table["return_std"] = np.sqrt((table.square - table.return_mean**2).clip(lower=0))
    return table.drop(columns="square")


def episode_table(rows: Sequence[EpisodeRow], config: Config) -> pd.DataFrame:
    """Test episodes of one run as a table with scores, for `by_physics` and `by_group`."""
    table = pd.DataFrame([row.to_csv() for row in rows], columns=list(EpisodeRow.__annotations__))
    table["return"] = [row.episode_return for row in rows]
    table["score"] = np.array([score_of(row, config) for row in rows], float)
    return table.assign(label=config.method, run="", protocol="")


def facts(table: pd.DataFrame) -> list[dict[str, Any]]:
    """Lines of `by_physics` or `by_group` as plain values, for JSON."""
    names = ["group", "sim_params", "episodes", "return_mean", "return_std", "score"]
    shown = table[[name for name in names if name in table]]
    lines: list[dict[str, Any]] = shown.to_dict("records")  # type: ignore[assignment]
    for line in lines:
        line["score"] = None if np.isnan(line["score"]) else line["score"]
        if "sim_params" in line:
            line["sim_params"] = parse_sim_params(line["sim_params"])
    return lines


def evaluation_facts(rows: Sequence[EpisodeRow], config: Config) -> dict[str, Any]:
    """Returns and scores of test episodes by group and by physics, for JSON."""
    episodes = episode_table(rows, config)
    return {"groups": facts(by_group(episodes)), "physics": facts(by_physics(episodes))}


def evaluation(rows: Sequence[EpisodeRow], config: Config, title: str) -> Table:
    """Lay out the returns of test episodes for a terminal: by group, then by physics."""
    episodes = episode_table(rows, config)
    physics, groups = facts(by_physics(episodes)), facts(by_group(episodes))
    scored = any(line["score"] is not None for line in physics)
    table = new_table(title, "physics", numbers=["episodes", "return", *["score"] * scored])
    names = varying([line["sim_params"] for line in physics])

    def cells(line: Mapping[str, Any]) -> list[str]:
        spread = f" ± {line['return_std']:,.1f}" if line["episodes"] > 1 else ""
        score = "–" if line["score"] is None else f"{line['score']:.2f}"
        return [str(line["episodes"]), f"{line['return_mean']:,.1f}{spread}", *[score] * scored]

    for group in groups:
        table.add_row(group_label(group["group"]), *cells(group), style="bold")
        for line in physics:
            if line["group"] == group["group"]:
                table.add_row(f"  {full_label(line['sim_params'], names)}", *cells(line))
        table.add_section()
    table.caption = (
        "return: mean ± standard deviation over episodes; every physics of a group counts once"
        + "; score: 0 = random actions, 1 = the paper's planner on the true dynamics" * scored
    )
    return table


class TextTable(Table):
    """A table whose texts are shown as they are: what is in brackets is no markup."""

    def add_row(self, *cells: Any, **look: Any) -> None:
        """Add a line of cells; strings are plain text."""
        plain = [Text(cell) if isinstance(cell, str) else cell for cell in cells]
        super().add_row(*plain, **look)


def new_table(title: str, *texts: str, numbers: Sequence[str] = ()) -> TextTable:
    """An empty table in the look of all others: columns of texts, then columns of numbers."""
    table = TextTable(
        *texts,
        title=Text(title, "bold"),
        title_justify="left",
        caption_justify="left",
        box=box.SIMPLE_HEAD,
    )
    table.caption_style = "dim"
    for name in numbers:
        table.add_column(name, justify="right")
    return table


def group_label(group: str) -> str:
    """Name a group for readers."""
    names = {
        TRAIN: "training physics",
        "unseen": "unseen physics",
        COLLECTED: "training physics, while collecting",
    }
    return names.get(group, f"unseen: {group.replace('_', ' ')}")


def distinct(physics: Iterable[Physics]) -> list[dict[str, float]]:
    """Different sets of simulator parameters, in ascending order."""
    unique = {tuple(sorted(sim_params.items())): dict(sim_params) for sim_params in physics}
    return [unique[key] for key in sorted(unique)]


def varying(physics: Sequence[Physics]) -> list[str]:
    """Names of the parameters that differ; all of them when none does."""
    names = sorted({name for sim_params in physics for name in sim_params})
    return [name for name in names if len({p.get(name) for p in physics}) > 1] or names


def value_label(sim_params: Physics, names: Sequence[str]) -> str:
    """Write the values of some parameters, for example `0.5` or `0.5, 2`."""
    return ", ".join(f"{sim_params[name]:g}" for name in names if name in sim_params)


def axis_label(names: Sequence[str]) -> str:
    """Write the names of some parameters with their units, for example `length (m)`."""
    units = [f" ({UNITS[name]})" if name in UNITS else "" for name in names]
    return ", ".join(n.replace("_", " ") + unit for n, unit in zip(names, units, strict=True))


def full_label(sim_params: Physics, names: Sequence[str]) -> str:
    """Write names, values and units, for example `length 0.5 m`."""
    return ", ".join(
        f"{name.replace('_', ' ')} {sim_params[name]:g} {UNITS.get(name, '')}".rstrip()
        for name in names
        if name in sim_params
    )
