"""Drawing a film: the picture of each step, the physics in force, and who planned."""

import dataclasses
import io
import itertools
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Int, UInt8
from PIL import Image, ImageDraw, ImageFont

from headway.errors import ConfigError
from headway.report.physics import full_label
from headway.report.style import FAINT, HEADS, INK

FORMATS = {".gif": "GIF", ".webp": "WEBP"}
WIDTH = 480  # pixels
MARGIN, LINE, ROW, GAP = 12, 18, 9, 2
MAX_RATE = 25  # frames per second; a viewer shows hardly more of a GIF
COLORS = 96  # of a GIF, for all frames together
PAPER = "#ffffff"
CAPTION = "head that each network of the ensemble planned with"
LAST_FRAME = 1500  # milliseconds that the end is seen


@dataclasses.dataclass(frozen=True)
class Moment:
    """One step of an episode, as it looked after the step."""

    image: UInt8[np.ndarray, "height width 3"]
    sim_params: Mapping[str, float]
    """The physics in force."""
    reward: float
    heads: Int[np.ndarray, " member"] | None
    """The head that each member planned with; None where the model has no heads."""


def checked(path: Path) -> Path:
    """Return a path that a film can be written to.

    Raises:
        ConfigError: Its ending is not that of a format for films.
    """
    if path.suffix.lower() not in FORMATS:
        raise ConfigError(f"{path} cannot be a film, allowed: names ending in .gif or .webp.")
    return path


def draw(moments: Sequence[Moment], steps_per_second: float, suffix: str) -> bytes:
    """Draw a film at the speed of the environment.

    Args:
        moments: Every step of the episode, at least one.
        steps_per_second: Of the environment. Steps are left out where they are too many to show.
        suffix: `.gif` or `.webp`.

    Returns:
        The content of the file.
    """
    stride = max(1, round(steps_per_second / MAX_RATE))
    shown = sorted({*range(0, len(moments), stride), len(moments) - 1})
    panel = Panel(moments)
    frames = [panel.frame(step) for step in shown]
    if suffix.lower() == ".gif":
        frames = _one_palette(frames)
    duration = round(1000 * stride / steps_per_second)
    durations = [duration] * (len(frames) - 1) + [LAST_FRAME]
    file = io.BytesIO()
    frames[0].save(
        file,
        FORMATS[suffix.lower()],
        save_all=True,
        append_images=frames[1:],
        duration=durations,
        loop=0,
        optimize=True,
        quality=70,
    )
    return file.getvalue()


class Panel:
    """The frames of one episode.

    Args:
        moments: Every step.
    """

    def __init__(self, moments: Sequence[Moment]):
        self._moments = moments
        self._returns = np.cumsum([moment.reward for moment in moments])
        self._names = list(moments[0].sim_params)
        self._font = ImageFont.load_default(size=14)
        self._small = ImageFont.load_default(size=11)
        scene = moments[0].image
        self._scene = WIDTH, round(WIDTH * scene.shape[0] / scene.shape[1])
        self._strips = self._draw_strips()
        caption = 0 if moments[0].heads is None else LINE
        self._height = self._scene[1] + 2 * MARGIN + LINE + caption + self._strips.height

    def frame(self, step: int) -> Image.Image:
        """The picture after a step, above what was planned until then."""
        moment, line = self._moments[step], self._scene[1] + MARGIN + LINE // 2
        frame = Image.new("RGB", (WIDTH, self._height), PAPER)
        frame.paste(Image.fromarray(moment.image).resize(self._scene, Image.Resampling.LANCZOS))
        pen = ImageDraw.Draw(frame)
        physics = full_label(moment.sim_params, self._names)
        pen.text((MARGIN, line), physics, INK, self._font, anchor="ls")
        counted = f"step {step + 1}   return {self._returns[step]:,.0f}"
        pen.text((WIDTH - MARGIN, line), counted, INK, self._font, anchor="rs")
        if moment.heads is not None:
            pen.text((MARGIN, line + LINE), CAPTION, FAINT, self._small, anchor="ls")
            until = MARGIN + self._column(step + 1)
            past = self._strips.crop((0, 0, until, self._strips.height))
            frame.paste(past, (0, line + LINE + MARGIN // 2))
        return frame

    def _column(self, step: int) -> int:
        """Where a step is on the strips, in pixels from their left end."""
        return round(step / len(self._moments) * (WIDTH - 2 * MARGIN))

    def _draw_strips(self) -> Image.Image:
        """The heads of all members at all steps, and when the physics changed."""
        heads = [moment.heads for moment in self._moments]
        rows = 0 if heads[0] is None else len(heads[0])
        strips = Image.new("RGB", (WIDTH, rows * (ROW + GAP) + 1), PAPER)
        pen = ImageDraw.Draw(strips)
        for step, chosen in enumerate(heads):
            left, right = MARGIN + self._column(step), MARGIN + self._column(step + 1) - 1
            for row, head in enumerate(() if chosen is None else chosen):
                top, color = row * (ROW + GAP), HEADS[int(head) % len(HEADS)]
                pen.rectangle((left, top, max(left, right), top + ROW - 1), color)
        for step in self._changes():
            x = MARGIN + self._column(step)
            pen.line((x, 0, x, strips.height), INK, 2)
        return strips

    def _changes(self) -> list[int]:
        """Steps that were the first under new physics."""
        pairs = itertools.pairwise(moment.sim_params for moment in self._moments)
        return [step for step, (old, new) in enumerate(pairs, start=1) if old != new]


def _one_palette(frames: Sequence[Image.Image]) -> list[Image.Image]:
    """Reduce frames to colours that they share, so that still parts do not flicker."""
    first, last = frames[0], frames[-1]
    sample = Image.new("RGB", (WIDTH, 3 * first.height + len(HEADS)), PAPER)
    for place, frame in enumerate((first, frames[len(frames) // 2], last)):
        sample.paste(frame, (0, place * first.height))
    pen = ImageDraw.Draw(sample)
    for row, color in enumerate(HEADS):
        pen.line((0, 3 * first.height + row, WIDTH, 3 * first.height + row), color)
    palette = sample.quantize(COLORS)
    return [frame.quantize(palette=palette, dither=Image.Dither.NONE) for frame in frames]
