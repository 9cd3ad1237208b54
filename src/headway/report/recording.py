"""One episode of a trained controller as a film: what it did, and with which heads it planned."""

import dataclasses
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np

from headway.config import Config
from headway.envs import make
from headway.envs.vector import Schedule
from headway.errors import BadEnvironmentError, ConfigError
from headway.planning.controller import Controller
from headway.report import film
from headway.report.film import Moment
from headway.task import env_options, episode_length
from headway.training.loading import load_agent
from headway.training.methods import config_to_evaluate
from headway.training.progress import Progress
from headway.training.run import RunDir, write_bytes


@dataclasses.dataclass(frozen=True)
class Recording:
    """A film that was written, and what it shows."""

    path: Path
    """The GIF or WebP file."""
    env: str
    """Short name of the environment."""
    sim_params: dict[str, float]
    """The physics at the end of the episode."""
    steps: int
    """Steps of the episode."""
    episode_return: float
    """Sum of rewards."""


def record(  # noqa: PLR0913 (keywords, all with a default)
    run_dir: str | Path,
    output: str | Path = "episode.gif",
    *,
    sim_params: Mapping[str, float] | None = None,
    schedule: Schedule | None = None,
    seed: int = 0,
    num_steps: int | None = None,
    settings: Mapping[str, Any] | None = None,
    progress: Progress | None = None,
) -> Recording:
    """Let a trained controller act in one environment and film it.

    Below the picture, a strip per ensemble member shows the head that it planned with at every
    step. Drawing the robots needs OSMesa or EGL.

    Args:
        run_dir: The run directory.
        output: The file to write; its ending, .gif or .webp, chooses the format.
        sim_params: The physics, drawn from the training physics by default. Parameters that are
            not named are drawn from them all the same.
        schedule: Physics that change during the episode, by step.
        seed: Seeds the start and the planner's draws.
        num_steps: Steps to film; a full episode by default.
        settings: Changes of `planner` settings by dotted name, as in `headway.evaluate`.
        progress: Shown while acting; silent by default.

    Raises:
        RunError: There is no trained run, or it is damaged.
        ConfigError: The ending, a simulator parameter, a step or a setting is not allowed.
        BadEnvironmentError: The environment cannot be drawn.
    """
    path = film.checked(Path(output))
    if num_steps is not None and num_steps < 1:
        raise ConfigError(f"num_steps is {num_steps}, allowed: at least 1.")
    run = RunDir(run_dir)
    config = config_to_evaluate(run.config(), settings or {})
    controller = Controller(load_agent(run, config), seed=seed)
    length = num_steps or episode_length(config)
    env = _environment(config)
    options = {"sim_params": dict(sim_params or {}), "schedule": dict(schedule or {})}
    moments: list[Moment] = []
    with progress or Progress() as shown:
        shown.phase("act", length)
        for moment in _episode(env, controller, options, seed, length):
            moments.append(moment)
            shown.advance()
    write_bytes(path, film.draw(moments, env.metadata.get("render_fps", 20), path.suffix))
    total = float(sum(moment.reward for moment in moments))
    return Recording(path, config.env, dict(moments[-1].sim_params), len(moments), total)


def _environment(config: Config) -> gymnasium.Env:
    """The environment of a run, ready to be drawn."""
    own = {"sim_params": config.sim_params} if config.sim_params else {}
    env = make(config.env, render_mode="rgb_array", **env_options(config), **own)
    return env.unwrapped  # episodes are cut here, not by Gymnasium


def _episode(
    env: gymnasium.Env, controller: Controller, options: dict[str, Any], seed: int, length: int
) -> Iterator[Moment]:
    """Act from a reset until the episode ends."""
    obs, info = env.reset(seed=seed, options=options)
    controller.reset(info.get("sim_params"))
    for _ in range(length):
        obs, reward, terminated, _, info = env.step(controller.act(obs))
        image = env.render()
        if not isinstance(image, np.ndarray) or image.ndim != 3:
            raise BadEnvironmentError(
                f"render() of {env} gave {type(image).__name__}, allowed: an image of shape"
                " [height, width, 3], as with render_mode='rgb_array'."
            )
        physics = dict(info.get("sim_params", options["sim_params"]))
        yield Moment(image, physics, float(reward), controller.heads)
        if terminated:
            return
