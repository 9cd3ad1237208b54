"""Train and load. Importing this, and loading a controller, bring in no simulator."""

import dataclasses
import sys
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from headway.config import Config
from headway.errors import ConfigError
from headway.models.compilation import prepare_jax
from headway.planning.controller import Controller
from headway.sim_params import SimParamSets
from headway.task import EnvSpec, Task, env_spec, name_spec
from headway.training.evaluate import returns_in_words
from headway.training.methods import config_to_evaluate, make_config
from headway.training.progress import Progress, make_progress
from headway.training.recordings import Data, read_log
from headway.training.run import EpisodeRow, Iteration, RunDir
from headway.training.train import OnIteration, continued, copy_run, train_run
from headway.training.trainers import load_agent


@dataclasses.dataclass(frozen=True)
class Run:
    """A trained run and its measurements."""

    path: Path
    """The run directory."""
    config: Config
    """All settings."""
    metrics: list[dict[str, Any]]
    """One entry per iteration, as in `metrics.jsonl`."""
    evaluation: list[EpisodeRow]
    """Every test episode, as in `evaluation.csv`."""

    @property
    def last_tests(self) -> list[EpisodeRow]:
        """The newest test episodes."""
        last = max((row.iteration for row in self.evaluation), default=0)
        return [row for row in self.evaluation if row.iteration == last]

    def controller(self, *, seed: int = 0, **options: Any) -> Controller:
        """The trained controller; options are those of `load`."""
        return load(self.path, seed=seed, **options)

    def __repr__(self) -> str:
        """One line: directory and last test returns."""
        name = f"{self.config.method} on {self.config.env}, seed {self.config.seed}"
        name += f", {len(self.metrics)} iterations{returns_in_words(self.last_tests)}"
        return f"Run({str(self.path)!r}: {name})"


def train(  # noqa: PLR0913 (keywords, all with a default)
    env: str | EnvSpec | Callable[..., Any],
    *,
    task: Task | Callable[..., Task] | None = None,
    sim_params: SimParamSets | Mapping[str, Any] | None = None,
    method: str = "tmcl",
    preset: str = "paper",
    seed: int = 0,
    run_dir: str | Path | None = None,
    from_run: str | Path | None = None,
    settings: Mapping[str, Any] | None = None,
    progress: Progress | None = None,
    resume_from_last_good: bool = False,
    on_iteration: OnIteration | None = None,
) -> Run:
    """Train a controller on environments whose physics vary; resume if it was begun before.

    A finished run goes on where `collection.num_iterations` is larger than before.

    Args:
        env: Short name or id of an environment; an EnvSpec; or, with a task, any id that Gymnasium
            knows or what makes the environment. Another process must know an EnvSpec, too:
            where a module holds it, it finds it, else `headway.register` tells it.
        task: The Task of an environment that has no EnvSpec, or its class; `headway.Task` itself
            leaves reward and end of an episode to the model, which learns them, and is the default
            of what makes an environment.
        sim_params: Physics of that environment, `{"train": {...}, "unseen": {...}}`, and
            instead of those of another.
        method: A name from `headway list methods`.
        preset: A name from `headway list presets`.
        seed: Makes the run repeatable.
        run_dir: Where everything is written; `runs/ENV-METHOD-PRESET-seedSEED` by default.
        from_run: A finished run, such as one of `fit`, whose copy goes on for as many iterations
            again, or up to `collection.num_iterations`; all other settings are its own.
        settings: Changes by dotted name, for example `{"planner.horizon": 20}`.
        progress: Shown while training; by default a bar on a terminal, lines in a notebook, and
            nothing elsewhere.
        resume_from_last_good: Where a file of the run is damaged, go back to the newest
            iteration whose files are all intact.
        on_iteration: Called with each iteration's line of `metrics.jsonl` (a dict) once it is
            saved, for a tracker of experiments. What it raises ends the run; the same command goes
            on with the next iteration.

    Raises:
        UnknownNameError: No such environment, method or preset.
        ConfigError: A setting is unknown, of the wrong type or out of range.
        RunError: The directory holds something else, is damaged, or in use.
        LimitError: The disk is full; nothing is lost.
        BadEnvironmentError: The environment broke its contract.
        DivergenceError: Fitting lost all finite numbers.
    """
    prepare_jax()
    if isinstance(sim_params, Mapping):
        sim_params = SimParamSets.from_dict(sim_params)
    if task is None and callable(env):
        task = Task
    if task is not None:
        if isinstance(env, EnvSpec) or sim_params is None:
            raise ConfigError(
                "sim_params are missing, or task is given with an EnvSpec, allowed: sim_params and"
                " perhaps task, with an id or what makes the environment; an EnvSpec has a Task."
            )
        make_task = (lambda: task) if isinstance(task, Task) else task
        env = EnvSpec(env_id=env, make_task=make_task, sim_params=sim_params)
    elif sim_params is not None:
        settings = {**(settings or {}), "sim_params": sim_params}
    env = name_spec(env)
    if from_run is None:
        config = make_config(env, method=method, preset=preset, seed=seed, settings=settings)
        path = Path(run_dir or _usual_dir(config))
    else:
        config = continued(from_run, settings)
        path = Path(run_dir or f"{Path(from_run)}-on")
        if env_spec(env).name != config.env:
            raise ConfigError(f"env is {env!r}, allowed: {config.env!r}, that of {from_run}.")
        copy_run(Path(from_run), path)
    options = {"on_iteration": on_iteration, "resume_from_last_good": resume_from_last_good}
    return _run(config, path, progress, **options)


def fit(  # noqa: PLR0913 (keywords, all with a default)
    data: Data,
    env: str,
    *,
    method: str = "tmcl",
    preset: str = "paper",
    seed: int = 0,
    run_dir: str | Path | None = None,
    settings: Mapping[str, Any] | None = None,
    held_out: float = 0.2,
    names: Mapping[str, str] | None = None,
    progress: Progress | None = None,
    resume_from_last_good: bool = False,
) -> Run:
    """Fit a model to recordings alone; no environment is stepped (docs/logged-data.md).

    The run's iterations are rounds of fitting, as many as training has. It can be loaded, tested
    and diagnosed as any other, and `train(from_run=...)` goes on collecting.

    Args:
        data: An `.npz` or Parquet file, a folder of them, a Minari data set (its folder, or
            `"minari:ID"`), or tables in memory: mappings with `obs` [time or time + 1, ...] and
            `action` [time, ...] in the environment's units.
        env: Short name or id of the environment whose Task they were recorded for.
        method: A name from `headway list methods`.
        preset: A name from `headway list presets`.
        seed: Makes the run repeatable; also draws what is held out.
        run_dir: Where everything is written; `runs/ENV-METHOD-PRESET-seedSEED-fit` by default.
        settings: Changes by dotted name.
        held_out: Share of the recordings on which errors are measured and nothing is fitted.
        names: What arrays are called where that is not guessed, several of them with commas:
            `{"obs": "angle,speed", "action": "torque"}`.
        progress: As in `train`.
        resume_from_last_good: As in `train`.

    Raises:
        ConfigError: A recording cannot be read, or does not fit the environment.
        RunError: The directory holds something else, is damaged, or in use.
    """
    prepare_jax()
    config = make_config(env, method=method, preset=preset, seed=seed, settings=settings)
    log = read_log(data, config, held_out, names or {})
    path = Path(run_dir or f"{_usual_dir(config)}-fit")
    return _run(log.config, path, progress, log=log, resume_from_last_good=resume_from_last_good)


def _run(config: Config, path: Path, progress: Progress | None, **options: Any) -> Run:
    watched = sys.stderr.isatty() or "ipykernel" in sys.modules
    run = train_run(config, path, progress or make_progress(quiet=not watched), **options)
    return Run(run.path, run.config(), run.metrics(), run.evaluation())


def _usual_dir(config: Config) -> Path:
    name = f"{config.env}-{config.method}-{config.preset}-seed{config.seed}"
    return Path("runs") / name.replace(":", "-").replace("/", "-")


def load(
    run_dir: str | Path,
    *,
    seed: int = 0,
    iteration: Iteration = None,
    settings: Mapping[str, Any] | None = None,
    **options: Any,
) -> Controller:
    """Load the controller of a run.

    Args:
        run_dir: The run directory.
        seed: Seeds the planner's draws.
        iteration: The iteration whose model acts, from 0, or `"best"`: the kept one whose
            controller collected the highest mean return. The newest by default.
        settings: Changes of `planner` settings by dotted name, for example
            `{"planner.num_candidates": 50}`, to control with another planner.
        options: Those of `Controller`, for example `deadline_ms=50`.

    Raises:
        RunError: There is no trained run, it does not keep the iteration, or it is damaged.
        ConfigError: A setting is unknown, of the wrong type or out of range, or none of the
            planner's; or as `Controller`.
    """
    run = RunDir(run_dir)
    config = config_to_evaluate(run.config(), settings or {}, ("planner",))
    return Controller(load_agent(run, config, iteration=iteration), seed=seed, **options)
