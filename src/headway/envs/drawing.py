"""Drawing the classic environments with Pillow, anti-aliased by drawing larger."""

import numpy as np
from PIL import Image, ImageDraw

WIDTH, HEIGHT = 640, 480
SCALE = 3  # pixels drawn per pixel shown, in each direction
PAPER, GRID, INK = (250, 250, 247), (226, 228, 226), (60, 66, 74)
CART, BODY, FORCE = (52, 101, 164), (204, 121, 60), (196, 60, 60)

Point = tuple[float, float]


class Canvas:
    """A sheet of paper measured in metres, with the origin in its middle."""

    def __init__(self, pixels_per_metre: float, origin: Point = (0.0, 0.0)):
        self._image = Image.new("RGB", (WIDTH * SCALE, HEIGHT * SCALE), PAPER)
        self._draw = ImageDraw.Draw(self._image)
        self._zoom = pixels_per_metre * SCALE
        self._origin = origin

    def pixel(self, point: Point) -> Point:
        """Where a point in metres is on the sheet."""
        x, y = point[0] - self._origin[0], point[1] - self._origin[1]
        return WIDTH * SCALE / 2 + x * self._zoom, HEIGHT * SCALE / 2 - y * self._zoom

    def line(self, start: Point, end: Point, width: float, color) -> None:
        """Draw a line with round ends; `width` in metres."""
        self._draw.line([self.pixel(start), self.pixel(end)], color, round(width * self._zoom))
        for point in (start, end):
            self.disc(point, width / 2, color)

    def disc(self, center: Point, radius: float, color) -> None:
        """Draw a filled circle."""
        (x, y), r = self.pixel(center), radius * self._zoom
        self._draw.ellipse((x - r, y - r, x + r, y + r), color)

    def box(self, center: Point, size: Point, radius: float, color) -> None:
        """Draw a filled rectangle with round corners."""
        (x, y), z = self.pixel(center), self._zoom / 2
        corners = x - size[0] * z, y - size[1] * z, x + size[0] * z, y + size[1] * z
        self._draw.rounded_rectangle(corners, radius * self._zoom, color)

    def ring(self, center: Point, radius: float, width: float, color) -> None:
        """Draw a circle."""
        (x, y), r = self.pixel(center), radius * self._zoom
        self._draw.ellipse((x - r, y - r, x + r, y + r), None, color, round(width * self._zoom))

    def polygon(self, points: list[Point], color) -> None:
        """Draw a filled polygon."""
        self._draw.polygon([self.pixel(point) for point in points], color)

    def arc(self, center: Point, radius: float, degrees: Point, width: float, color) -> None:
        """Draw a part of a circle; degrees count clockwise from the right."""
        (x, y), r = self.pixel(center), radius * self._zoom
        box = (x - r, y - r, x + r, y + r)
        self._draw.arc(box, degrees[0], degrees[1], color, round(width * self._zoom))

    def image(self) -> np.ndarray:
        """Return the picture as `uint8` [height, width, 3]."""
        small = self._image.resize((WIDTH, HEIGHT), Image.Resampling.BOX)
        return np.asarray(small, np.uint8).copy()


def cart_pole(x: float, angle: float, length: float, push: float, mass_scale: float) -> np.ndarray:
    """Draw a cart with its pole; heavier ones are drawn thicker.

    Args:
        x: Position of the cart (m).
        angle: Of the pole, 0 upright, positive towards positive x (rad).
        length: Of the pole (m).
        push: Force in units of its limit, drawn as an arrow.
        mass_scale: Scale of both masses.
    """
    canvas = Canvas(122.0, origin=(0.0, 0.12))
    bulk = float(np.clip(mass_scale, 0.05, 4.0)) ** (1 / 3)
    for mark in np.arange(-2.0, 2.1, 0.5):
        canvas.line((mark, -0.16), (mark, -0.2), 0.012, GRID)
    canvas.line((-2.4, -0.13), (2.4, -0.13), 0.03, GRID)
    for end in (-2.4, 2.4):
        canvas.line((end, -0.2), (end, 0.1), 0.03, INK)
    width, height = 0.4 * bulk, 0.2 * bulk
    canvas.box((x, -0.115 + height / 2), (width, height), 0.04, CART)
    pivot = (x, -0.115 + height / 2)
    tip = (x + length * np.sin(angle), pivot[1] + length * np.cos(angle))
    canvas.line(pivot, tip, 0.07 * bulk, BODY)
    canvas.disc(pivot, 0.028, PAPER)
    if abs(push) > 0.02:
        _arrow(canvas, (x + np.sign(push) * (width / 2 + 0.05), pivot[1]), 0.5 * push)
    return canvas.image()


def _arrow(canvas: Canvas, start: Point, length: float) -> None:
    head = 0.09 * np.sign(length)
    end = start[0] + length
    canvas.line(start, (end, start[1]), 0.03, FORCE)
    tip, back = end + head, end - 0.02 * np.sign(length)
    canvas.polygon([(tip, start[1]), (back, start[1] + 0.06), (back, start[1] - 0.06)], FORCE)


def pendulum(angle: float, length: float, torque: float) -> np.ndarray:
    """Draw a rod that turns around the middle, and an arc for the torque.

    Args:
        angle: 0 upright, positive counter-clockwise (rad).
        length: Of the rod (m).
        torque: In units of its limit.
    """
    canvas = Canvas(122.0)
    for radius in (0.5, 1.0, 1.5):
        canvas.ring((0.0, 0.0), radius, 0.01, GRID)
    canvas.line((0.0, 1.6), (0.0, 1.85), 0.012, GRID)
    tip = (-length * np.sin(angle), length * np.cos(angle))
    canvas.line((0.0, 0.0), tip, 0.13, BODY)
    canvas.disc((0.0, 0.0), 0.035, INK)
    if abs(torque) > 0.02:
        _torque(canvas, torque)
    return canvas.image()


def _torque(canvas: Canvas, torque: float) -> None:
    """An arc from the top, in the direction and proportion of the torque."""
    radius, sweep = 0.26, 150.0 * torque
    degrees = (-90.0 - sweep, -90.0) if torque > 0 else (-90.0, -90.0 - sweep)
    canvas.arc((0.0, 0.0), radius, degrees, 0.03, FORCE)
    end = np.deg2rad(90.0 + sweep)
    radial = np.array([np.cos(end), np.sin(end)])
    along = np.array([-radial[1], radial[0]]) * np.sign(torque)
    center = (radius - 0.015) * radial
    corners = [center + 0.1 * along, center + 0.06 * radial, center - 0.06 * radial]
    canvas.polygon([(float(x), float(y)) for x, y in corners], FORCE)
