"""One tidy table of any number of runs, with scores, and its terminal form.

Reads run directories and the tables kept in `results/`, whose settings may be of an older shape:
only what is needed is read, and damage costs one line.
"""

import contextlib
import dataclasses
import itertools
import json
import operator
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from rich import box
from rich.table import Column, Table

from headway.config import TOLERANCE, Config, flatten
from headway.errors import RunError
from headway.task import env_names, env_spec
from headway.training.methods import METHODS, REFERENCES
from headway.training.recordings import HELD_OUT, RECORDING
from headway.training.references import score, score_of
from headway.training.run import EpisodeRow, RunDir, parse_sim_params

TRAIN, COLLECTED = "train", "collected"
PHASES = ("collect", "fit", "evaluate")
SERIES = ["env", "label", "seed", "run"]  # the keys of a run in every table

_FILES: dict[str, tuple[str, str, dict[str, type]]] = {  # by table: file, loss without it, columns
    "episodes": ("evaluation.csv", "no final result", {
        "iteration": int, "group": str, "sim_params": str, "episode": int, "return": float,
    }),
    "assignments": ("assignments.csv", "no head shares", {
        "iteration": int, "member": int, "head": int, "sim_params": str, "share": float,
    }),
    "errors": ("prediction_error.csv", "no prediction errors", {
        "iteration": int, "group": str, "step": int, "error": float,
    }),
}  # fmt: skip
_DAMAGE = (OSError, ValueError, KeyError, TypeError, AttributeError, ArithmeticError)
_NO_VARIANT = ("env", "method", "preset", "seed", "log", "log.rounds", "log.sha256", *TOLERANCE)
_LONG_LABEL = 60  # letters
MOST_RECORDINGS = 40  # lines

Physics = Mapping[str, float]


@dataclasses.dataclass(frozen=True)
class Runs:
    """Tables of some runs; each line names its run by the columns `SERIES`."""

    runs: pd.DataFrame
    """A line per run: method and its place in the order of methods, preset, protocol, iterations,
    planned, device, minutes by phase."""
    episodes: pd.DataFrame
    """Test episodes: iteration, group, sim_params, episode, return, score (NaN: unknown)."""
    curves: pd.DataFrame
    """Mean returns by iteration, timesteps and group; `collected` while collecting."""
    collected: pd.DataFrame
    """Episodes collected for training: iteration, group, episode, return."""
    assignments: pd.DataFrame
    """Rows of `assignments.csv` after the newest iteration."""
    errors: pd.DataFrame
    """Rows of `prediction_error.csv` after the newest tested iteration."""
    settings: Mapping[str, Mapping[str, Any]]
    """Settings by dotted name, by run."""
    notes: list[tuple[str, str]]
    """Remarks on runs: path of the run, one line."""

    @property
    def finished(self) -> pd.Series:
        """Paths of the runs with every iteration done."""
        return self.runs.loc[self.runs.iterations >= self.runs.planned, "run"]

    @property
    def final(self) -> pd.DataFrame:
        """Test episodes after the last iteration of finished runs."""
        last = self.runs[["run", "planned"]].drop_duplicates().set_index("run")["planned"] - 1
        found = self.episodes[self.episodes["run"].isin(self.finished)]
        return found[found.iteration == found["run"].map(last)]


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
    found: dict[Path, None] = {}
    for path in map(Path, paths):
        if not path.is_dir():
            raise RunError(f"{path} is not a directory, allowed: run directories or folders.")
        below = sorted(file.parent for file in path.rglob("config.json"))
        if not below:
            raise RunError(f"{path} holds no run, allowed: run directories or folders of them.")
        found.update(dict.fromkeys([path] if path in below else below))
    read = [run for path in found if (run := _read_run(path, notes)) is not None]
    if not read:
        raise RunError(f"none of {len(found)} runs can be read: {notes[0][1]}")
    read.sort(key=lambda run: (-run["iterations"], run["run"]))
    read.sort(key=operator.itemgetter("env", "order", "method", "seed"))
    kept: dict[str, dict[str, Any]] = {}
    for run in read:
        name = json.dumps({k: v for k, v in run["settings"].items() if k not in TOLERANCE})
        first = kept.setdefault(name, run)
        if first is not run:
            notes.append((run["run"], f"left out: same settings and seed as {first['run']}."))
    settings = {run["run"]: run.pop("settings") for run in kept.values()}
    joined = {
        name: pd.concat([run.pop(name).assign(run=run["run"]) for run in kept.values()])
        for name in ("curves", "collected", *_FILES)
    }
    runs = pd.DataFrame(list(kept.values()))
    runs["label"] = _labels(runs, settings)
    names = runs[[*SERIES, "method", "protocol"]]
    merged = {name: names.merge(table, on="run") for name, table in joined.items()}
    made = Runs(runs, **merged, settings=settings, notes=notes)
    made.episodes["score"] = _scores(made)
    return made


def _read_run(path: Path, notes: list[tuple[str, str]]) -> dict[str, Any] | None:
    """Facts, settings and tables of a run; None where not even its settings can be read."""

    @contextlib.contextmanager
    def noted(lost: str) -> Iterator[None]:
        try:
            yield
        except FileNotFoundError:
            pass
        except _DAMAGE as error:
            reason = f"{type(error).__name__} {error}".splitlines()[0]
            notes.append((str(path), f"{lost}: {reason[:200]}"))

    run = {"run": str(path), **_summaries("")}
    with noted("left out"):
        content = json.loads((path / "config.json").read_bytes())
        settings = flatten(content.get("config", content), whole=("sim_params", "env_options"))
        run |= {
            "env": str(settings["env"]),
            "method": str(settings["method"]),
            "order": [*METHODS, settings["method"]].index(settings["method"]),
            "preset": str(settings.get("preset", "?")),
            "seed": int(settings["seed"]),
            "device": str(content.get("device", "?")),
            "protocol": _protocol(settings),
            "settings": settings,
        }
    if "settings" not in run:
        return None
    with noted("no curve, times or final result"):
        run |= _summaries((path / "metrics.jsonl").read_text())
    for name, (file, lost, kinds) in _FILES.items():
        run[name] = pd.DataFrame({c: pd.Series(dtype=kind) for c, kind in kinds.items()})
        with noted(lost):
            table = _read_table(path / file, kinds)
            newest = table.iteration == table.iteration.max()
            run[name] = table if name == "episodes" else table[newest]
    done = run["iterations"]
    planned = run["planned"] = int(run["settings"].get("collection.num_iterations", done))
    if done < planned:
        text = f"{done} of {planned} iterations are finished"
        notes.append((str(path), f"{text}: it is in the curves, not in the final results."))
    elif planned - 1 not in set(run["episodes"].iteration):
        notes.append((str(path), "no test episodes after the last iteration: no final result."))
    return run


def _read_table(path: Path, kinds: Any) -> pd.DataFrame:
    missing = {name: ["nan"] for name in ("share", "error")}
    table = pd.read_csv(path, dtype=kinds, keep_default_na=False, na_values=missing)[list(kinds)]
    if "return" in table and not np.isfinite(table["return"]).all():
        raise ValueError(f"{path.name} holds a return that is no finite number")
    for text in table.get("sim_params", pd.Series(dtype=str)).unique():
        parse_sim_params(text)
    return table


def _summaries(metrics: str) -> dict[str, Any]:
    """Number of iterations, minutes by phase, curves and collected returns of `metrics.jsonl`."""
    lines = [json.loads(line) for line in metrics.splitlines()]
    curves, collected = [], []
    for line in lines:
        when, summaries = int(line["iteration"]), dict(line.get("evaluation", {}))
        if line.get("collection"):
            summaries[COLLECTED] = line["collection"]
            returns = enumerate(map(float, line["collection"]["returns"]))
            collected += [(when, COLLECTED, episode, value) for episode, value in returns]
        for group, summary in summaries.items():
            curves.append((when, int(line["timesteps"]), group, float(summary["return_mean"])))
    seconds = [line.get("seconds", {}) for line in lines]
    columns = ["iteration", "timesteps", "group", "return"]
    return {
        "iterations": len(lines),
        **{phase: sum(s.get(phase, 0.0) for s in seconds) / 60 for phase in PHASES},
        "curves": pd.DataFrame(curves, columns=columns),
        "collected": pd.DataFrame(collected, columns=["iteration", "group", "episode", "return"]),
    }


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
    labels = []
    for method, run in zip(runs.method, runs["run"], strict=True):
        variant = [
            f"{name.rpartition('.')[2].replace('_', ' ')} {value_text(settings[run].get(name))}"
            for name in names[method]
        ]
        labels.append(", ".join([method, *variant]))
    numbers = {label: number for number, label in enumerate(dict.fromkeys(labels), start=1)}
    return [
        label if len(label) <= _LONG_LABEL else f"{method}, variant {numbers[label]}"
        for method, label in zip(runs.method, labels, strict=True)
    ]


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
    found.runs["is_reference"] = [
        key in single for key in zip(found.runs.env, found.runs.method, strict=True)
    ]
    if found.runs.is_reference.all():
        found.runs["is_reference"] = False
    place = ["method", "env", "protocol", "sim_params"]
    levels = found.final.groupby([*place, "run"])["return"].mean().groupby(place).mean().to_dict()
    scores = []
    for env, protocol, sim_params, value in found.episodes[[*place[1:], "return"]].to_numpy():
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
    parts = by_physics(episodes).assign(square=lambda t: t.return_std**2 + t.return_mean**2)
    keys = [*SERIES, "method", "protocol", "group"]
    table = parts.groupby(keys, sort=False, as_index=False).agg(
        episodes=("episodes", "sum"),
        return_mean=("return_mean", "mean"),
        square=("square", "mean"),
        score=("score", lambda scores: scores.mean(skipna=False)),
    )
    table["return_std"] = np.sqrt((table.square - table.return_mean**2).clip(lower=0))
    return table.drop(columns="square")


def evaluation(
    rows: Sequence[EpisodeRow], config: Config, title: str = ""
) -> tuple[dict[str, Any], Table]:
    """Summarise test episodes of one run by group and by physics.

    Returns:
        Returns and scores as plain values for JSON, and laid out for a terminal.
    """
    own = {"label": config.method, "run": "", "protocol": ""}
    episodes = pd.DataFrame(
        [{**row.to_csv(), **own, "score": score_of(row, config)} for row in rows]
    ).astype({"score": float})
    names = ["group", "sim_params", "episodes", "return_mean", "return_std", "score"]
    facts: dict[str, list[dict[Any, Any]]] = {
        name: summary.filter(names).to_dict("records")
        for name, summary in (("groups", by_group(episodes)), ("physics", by_physics(episodes)))
    }
    for line in itertools.chain(*facts.values()):
        line["score"] = None if np.isnan(line["score"]) else line["score"]
        if "sim_params" in line:
            line["sim_params"] = parse_sim_params(line["sim_params"])
    scored = any(line["score"] is not None for line in facts["physics"])
    table = new_table(title, "physics", numbers=["episodes", "return", *["score"] * scored])
    names = varying([line["sim_params"] for line in facts["physics"]])
    for group in facts["groups"]:
        parts = [line for line in facts["physics"] if line["group"] == group["group"]]
        for line in (group, *parts):
            name = group_label(line["group"])
            if line is not group:
                name = f"  {full_label(line['sim_params'], names)}"
            spread = f" ± {line['return_std']:,.1f}" if line["episodes"] > 1 else ""
            score = "–" if line["score"] is None else f"{line['score']:.2f}"
            cells = [str(line["episodes"]), f"{line['return_mean']:,.1f}{spread}"]
            table.add_row(name, *cells, *[score] * scored, style="bold" if line is group else None)
        table.add_section()
    table.caption = (
        "return: mean ± standard deviation over episodes; every physics of a group counts once"
        + "; score: 0 = random actions, 1 = the paper's planner on the true dynamics" * scored
    )
    return facts, table


def fitted(run_dir: str | Path) -> tuple[dict[str, Any], Table, Table]:
    """Summarise a fit of recordings: errors by imagined step, and the heads of each recording.

    Returns:
        Plain values for JSON, and both tables for a terminal.
    """
    run = RunDir(run_dir)
    metrics = run.metrics()
    errors, recordings = metrics[-1]["held_out_error"], metrics[0]["recordings"]
    steps = [step for step in (1, 2, 5, 10, 15, 20, 25, 30) if step <= len(errors)]
    title = "Error of held-out recordings by imagined step"
    accuracy = new_table(title, numbers=[str(step) for step in steps])
    accuracy.add_row(*(f"{errors[step - 1]:.3g}" for step in steps))
    accuracy.caption = "in standard deviations; 1 is no better than the mean"
    rows = pd.DataFrame(run.assignments(), columns=list(_FILES["assignments"][2]))
    rows = rows[rows.iteration == metrics[-1]["iteration"]]
    found = []
    for text, own in rows.groupby("sim_params"):
        shares = own.pivot(index="member", columns="head", values="share")
        physics = parse_sim_params(str(text))
        number = int(physics.pop(RECORDING))
        best = {"heads": shares.idxmax(axis=1).tolist(), "share": float(shares.max(axis=1).mean())}
        found.append({"recording": number, "sim_params": physics, **recordings[number], **best})
    found.sort(key=lambda row: (row["heads"], row["recording"]))
    columns = ("recording", "share", "transitions", "pieces")
    title = "Which head of each member explains a recording best"
    heads = new_table(title, "heads", "physics", "file", numbers=columns)
    names = varying([row["sim_params"] for row in found])
    for row in found[:MOST_RECORDINGS]:
        cells = " ".join(map(str, row["heads"])), full_label(row["sim_params"], names) or "–"
        numbers = [f"{row[n]:.0%}" if n == "share" else str(row[n]) for n in columns]
        heads.add_row(*cells, row["file"], *numbers)
    heads.caption = (
        f"share: of its segments, mean over members, whose head numbers are unrelated;"
        f" {max(len(found) - MOST_RECORDINGS, 0)} more in assignments.csv,"
        f" {sum(row['held_out'] for row in recordings)} held out"
    )
    return {"held_out_error": errors, "recordings": found}, accuracy, heads


def new_table(title: str, *texts: str, numbers: Sequence[str] = ()) -> Table:
    """An empty table in the look of all others: columns of texts, then columns of numbers."""
    return Table(
        *texts,
        *(Column(name, justify="right") for name in numbers),
        title=title,
        title_style="bold",
        title_justify="left",
        caption_style="dim",
        caption_justify="left",
        box=box.SIMPLE_HEAD,
    )


def group_label(group: str) -> str:
    """Name a group for readers."""
    names = {
        TRAIN: "training physics",
        "unseen": "unseen physics",
        COLLECTED: "training physics, while collecting",
        HELD_OUT: "held-out recordings",
    }
    return names.get(group, f"unseen: {group.replace('_', ' ')}")


def distinct(physics: Iterable[Physics]) -> list[dict[str, float]]:
    """Different sets of simulator parameters, in ascending order."""
    return [dict(items) for items in sorted({tuple(sorted(one.items())) for one in physics})]


def varying(physics: Sequence[Physics]) -> list[str]:
    """Names of the parameters that differ; all of them when none does."""
    names = sorted({name for sim_params in physics for name in sim_params})
    return [name for name in names if len({p.get(name) for p in physics}) > 1] or names


def value_label(sim_params: Physics, names: Sequence[str]) -> str:
    """Write the values of some parameters, for example `0.5` or `0.5, 2`."""
    return ", ".join(f"{sim_params[name]:g}" for name in names if name in sim_params)


def axis_label(names: Sequence[str]) -> str:
    """Write the names of some parameters, for example `length, mass scale`."""
    return ", ".join(name.replace("_", " ") for name in names)


def full_label(sim_params: Physics, names: Sequence[str]) -> str:
    """Write names and values, for example `length 0.5`."""
    known = [name for name in names if name in sim_params]
    return ", ".join(f"{name.replace('_', ' ')} {sim_params[name]:g}" for name in known)
