"""One episode of a trained controller as a film: what it did, and with which heads it planned."""

import dataclasses
import io
import itertools
import warnings
from collections.abc import Mapping, Sequence
from contextlib import closing
from pathlib import Path
from typing import Any

import imageio.v3 as iio
import numpy as np
from jaxtyping import Int, UInt8
from PIL import Image, ImageDraw, ImageFont

from headway.config import override
from headway.envs.vector import Schedule
from headway.errors import BadEnvironmentError, ConfigError
from headway.lab.figures import FAINT, HEADS, INK
from headway.lab.tables import full_label
from headway.planning.controller import Controller
from headway.task import episode_length
from headway.training.environments import Environments, raising
from headway.training.files import check_target, write_bytes
from headway.training.methods import config_to_evaluate
from headway.training.progress import Progress
from headway.training.run import Iteration, RunDir
from headway.training.trainers import load_agent

FORMATS = (".gif", ".mp4")
WIDTH, MARGIN, LINE, ROW, GAP, TRACE = 480, 12, 18, 9, 2, 28  # pixels
MAX_RATE = 25  # frames per second; a viewer shows hardly more of a GIF
LIGHT = "#c4c4c4"
LAST_FRAME = 1.5  # seconds that the end is seen


@dataclasses.dataclass(frozen=True)
class Moment:
    """One step of an episode, as it looked after the step."""

    image: UInt8[np.ndarray, "height width 3"]
    sim_params: Mapping[str, float]
    """The physics in force."""
    action: np.ndarray
    """The action that led here, in the environment's units."""
    reward: float
    heads: Int[np.ndarray, " member"] | None
    """The head that each member planned with; None where the model has no heads."""


@dataclasses.dataclass(frozen=True)
class Recording:
    """A film that was written, and what it shows."""

    path: Path
    """The GIF or MP4 file."""
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
    iteration: Iteration = None,
    settings: Mapping[str, Any] | None = None,
    progress: Progress | None = None,
) -> Recording:
    """Let a trained controller act in one environment, as it was trained in, and film it.

    Below the picture, a strip per ensemble member shows the head that it planned with at every
    step. Drawing the robots needs OSMesa or EGL.

    Args:
        run_dir: The run directory.
        output: The file to write; its ending, .gif or .mp4, chooses the format.
        sim_params: The physics, drawn from the training physics by default. Parameters that are
            not named are drawn from them all the same.
        schedule: Physics that change during the episode, by step.
        seed: Seeds the start and the planner's draws.
        num_steps: Steps to film; a full episode by default.
        iteration: The iteration whose model acts, as in `headway.load`; the newest by default.
        settings: Changes of `planner` settings by dotted name, as in `headway.evaluate`.
        progress: Shown while acting; silent by default.

    Raises:
        RunError: There is no trained run, it does not keep the iteration, or it is damaged.
        ConfigError: The ending, a simulator parameter, a step or a setting is not allowed.
        BadEnvironmentError: The environment cannot be drawn, or broke.
    """
    path = Path(output)
    if path.suffix.lower() not in FORMATS:
        raise ConfigError(f"{path} cannot be a film, allowed: names ending in .gif or .mp4.")
    if num_steps is not None and num_steps < 1:
        raise ConfigError(f"num_steps is {num_steps}, allowed: at least 1.")
    check_target(path)
    run = RunDir(run_dir)
    config = config_to_evaluate(run.config(), settings or {}, ("planner",))
    controller = Controller(load_agent(run, config, iteration=iteration), seed=seed)
    length = num_steps or episode_length(config)
    if late := [step for step in schedule or () if isinstance(step, int) and step >= length]:
        raise ConfigError(f"schedule has step {late[0]}, allowed: below {length}, the film's end.")
    config = override(config, {"collection.episode_length": length})
    options = {"sim_params": dict(sim_params or {}), "schedule": dict(schedule or {})}
    moments: list[Moment] = []
    with closing(Environments.make(config, film=True)) as made, progress or Progress() as shown:
        env: Any = made.vector
        with raising(config.env, "reset"):
            obs, info = env.reset(seed=seed, options=options)
            controller.reset(_physics(info))
        shown.phase("act", length)
        for step in range(1, length + 1):
            action = controller.act(obs[0])
            with raising(config.env, f"step {step}"):
                obs, reward, terminated, truncated, info = env.step(np.asarray(action)[None])
                physics, image = _physics(info), made.frame()
            seen = Moment(image, physics, np.ravel(action), float(reward[0]), controller.heads)
            moments.append(seen)
            shown.advance()
            if terminated[0] or truncated[0]:
                break
    content = film(moments, env.metadata["render_fps"] or MAX_RATE, path.suffix.lower())
    write_bytes(path, content)
    total = float(sum(moment.reward for moment in moments))
    return Recording(path, config.env, dict(moments[-1].sim_params), len(moments), total)


def _physics(info: Mapping[str, Any]) -> dict[str, float]:
    """The physics in force, unless the episode broke."""
    if "broken" in info:
        raise BadEnvironmentError(f"it broke, {info['broken'][0]}")
    return {name: float(value) for name, (value,) in info["sim_params"].items()}


def film(moments: Sequence[Moment], steps_per_second: float, suffix: str) -> bytes:
    """Make a film at the speed of the environment.

    Args:
        moments: Every step of the episode, at least one.
        steps_per_second: Of the environment. Steps are left out where they are too many to show.
        suffix: `.gif` or `.mp4`.

    Returns:
        The content of the file.
    """
    stride = max(1, round(steps_per_second / MAX_RATE))
    shown = sorted({*range(0, len(moments), stride), len(moments) - 1})
    frames = draw(moments, shown)
    rate = steps_per_second / stride
    if suffix == ".mp4":
        images = [np.asarray(frame) for frame in frames + frames[-1:] * round(LAST_FRAME * rate)]
        look: dict[str, Any] = {"codec": "libx264", "macro_block_size": 2, "quality": 7}
        with warnings.catch_warnings():  # JAX's, of a fork that at once becomes ffmpeg
            warnings.simplefilter("ignore", RuntimeWarning)
            return iio.imwrite(
                "<bytes>", images, extension=".mp4", plugin="FFMPEG", fps=rate, **look
            )
    # One palette for all frames, so that still parts do not flicker.
    sample = Image.new("RGB", (WIDTH, 3 * frames[0].height + len(HEADS)))
    for place, frame in enumerate((frames[0], frames[len(frames) // 2], frames[-1])):
        sample.paste(frame, (0, place * frame.height))
    for row, color in enumerate(HEADS, start=3 * frames[0].height):
        ImageDraw.Draw(sample).line((0, row, WIDTH, row), color)
    palette = sample.quantize(96)
    first, *others = [f.quantize(palette=palette, dither=Image.Dither.NONE) for f in frames]
    durations = [round(1000 / rate)] * len(others) + [round(1000 * LAST_FRAME)]
    file = io.BytesIO()
    first.save(file, "GIF", save_all=True, append_images=others, duration=durations, loop=0)
    return file.getvalue()


def draw(moments: Sequence[Moment], shown: Sequence[int]) -> list[Image.Image]:
    """Draw the pictures after some steps, above heads, actions and rewards until then.

    A line through the strips marks where the physics changed. Traces reach from the least to the
    largest value of the episode.
    """
    names = list(moments[0].sim_params)
    font, small = ImageFont.load_default(size=14), ImageFont.load_default(size=11)
    returns = np.cumsum([moment.reward for moment in moments])
    columns = np.linspace(MARGIN, WIDTH - MARGIN, len(moments) + 1).round().astype(int)
    members = 0 if moments[0].heads is None else len(moments[0].heads)
    traces = {
        "action": np.stack([moment.action for moment in moments], axis=1),
        "reward": np.array([[moment.reward for moment in moments]]),
    }
    below = members * (ROW + GAP)
    strips = Image.new("RGB", (WIDTH, below + len(traces) * (LINE + TRACE)), "white")
    pen = ImageDraw.Draw(strips)
    for place, values in enumerate(traces.values(), start=1):
        base, low = below + place * (LINE + TRACE) - GAP, values.min()
        heights = base - (TRACE - 2 * GAP) * (values - low) / max(np.ptp(values), 1e-9)
        for row, color in zip(heights.tolist(), itertools.cycle((INK, FAINT, LIGHT))):
            pen.line([*zip(columns[1:].tolist(), row, strict=True)], color)
    for step, moment in enumerate(moments):
        left, right = int(columns[step]), int(columns[step + 1])
        for row, head in enumerate(() if moment.heads is None else moment.heads):
            top = row * (ROW + GAP)
            box = (left, top, max(left, right - 1), top + ROW - 1)
            pen.rectangle(box, HEADS[int(head) % len(HEADS)])
        if step and moment.sim_params != moments[step - 1].sim_params:
            pen.line((left, 0, left, strips.height), INK, 2)
    image = moments[0].image
    scene = (WIDTH, round(WIDTH * image.shape[0] / image.shape[1]))
    line = scene[1] + MARGIN + LINE // 2
    height = line + LINE // 2 + MARGIN + LINE * bool(members) + strips.height
    frames = []
    for step in shown:
        moment = moments[step]
        frame = Image.new("RGB", (WIDTH, height + height % 2), "white")  # MP4 wants even sizes
        frame.paste(Image.fromarray(moment.image).resize(scene, Image.Resampling.LANCZOS))
        pen = ImageDraw.Draw(frame)
        pen.text((MARGIN, line), full_label(moment.sim_params, names), INK, font, anchor="ls")
        counted = f"step {step + 1}   return {returns[step]:,.0f}"
        pen.text((WIDTH - MARGIN, line), counted, INK, font, anchor="rs")
        if members:
            caption = "head that each network of the ensemble planned with"
            pen.text((MARGIN, line + LINE), caption, FAINT, small, anchor="ls")
        past = strips.crop((0, 0, int(columns[step + 1]), strips.height))
        top = line + LINE * bool(members) + MARGIN // 2
        frame.paste(past, (0, top))
        for place, name in enumerate(traces):
            middle = top + below + place * (LINE + TRACE) + LINE // 2
            pen.text((MARGIN, middle), name, FAINT, small, anchor="lm")
        frames.append(frame)
    return frames
