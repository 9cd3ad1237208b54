# pyright: reportAttributeAccessIssue=false
# (the names compiled into mujoco have no stubs)

"""Pictures without a screen: Pillow draws the classic environments, EGL or OSMesa the robots."""

import ctypes.util
import importlib
import os
import sys
from collections.abc import Mapping
from typing import Any

import numpy as np
from PIL import Image, ImageDraw

from headway.errors import BadEnvironmentError
from headway.worlds.classic import CartPoleSwingUp, PendulumTask

WIDTH, HEIGHT = 640, 480
SCALE = 3  # Pillow's lines are jagged, so they are drawn larger and averaged
ZOOM = 122 * SCALE  # pixels drawn per metre

PAPER, GRID, INK = (250, 250, 247), (226, 228, 226), (60, 66, 74)
CART, BODY, FORCE = (52, 101, 164), (204, 121, 60), (196, 60, 60)
HEADS = ("#0173b3", "#e69f00", "#019f74", "#cc79a7", "#56b4e9", "#d65f01", "#f0e442", "#999999")
"""Colours of prediction heads, here and in figures."""

Point = tuple[float, float]


class _Canvas:
    """A sheet of paper measured in metres, with the origin in its middle."""

    def __init__(self) -> None:
        self.image = Image.new("RGB", (WIDTH * SCALE, HEIGHT * SCALE), PAPER)
        self.draw = ImageDraw.Draw(self.image)

    def pixel(self, point: Any) -> Point:
        return WIDTH * SCALE / 2 + point[0] * ZOOM, HEIGHT * SCALE / 2 - point[1] * ZOOM

    def box(self, center: Point, size: Point) -> tuple[float, float, float, float]:
        """Pixels of a rectangle."""
        (x, y), half = self.pixel(center), ZOOM / 2
        return x - size[0] * half, y - size[1] * half, x + size[0] * half, y + size[1] * half

    def disc(self, center: Point, radius: float, color, *, outline: int = 0) -> None:
        """Fill a circle, or draw its outline with so many pixels."""
        box = self.box(center, (2 * radius, 2 * radius))
        self.draw.ellipse(box, None if outline else color, color, outline or 1)

    def line(self, start: Point, end: Point, width: float, color) -> None:
        """Draw a line with round ends."""
        self.draw.line([self.pixel(start), self.pixel(end)], color, round(width * ZOOM))
        for point in (start, end):
            self.disc(point, width / 2, color)

    def arrow_head(self, point: Any, along: Any) -> None:
        """Draw the head of an arrow that points along a unit vector."""
        point, along = np.array(point), np.array(along)
        across = 0.06 * np.array([-along[1], along[0]])
        corners = point + 0.1 * along, point + across, point - across
        self.draw.polygon([self.pixel(corner) for corner in corners], FORCE)

    def frame(self) -> np.ndarray:
        """Return the picture as `uint8` [height, width, 3]."""
        small = self.image.resize((WIDTH, HEIGHT), Image.Resampling.BOX)
        return np.asarray(small, np.uint8).copy()


def cart_pole(state: np.ndarray, push: float, sim_params: Mapping[str, float]) -> np.ndarray:
    """Draw a cart with its pole and the force on it; heavier ones are drawn thicker."""
    canvas, track, length = _Canvas(), -0.25, CartPoleSwingUp.pole_length
    x, _, angle, _ = state
    push = push * sim_params["gain"]
    bulk = float(np.clip(sim_params["mass_scale"], 0.05, 4.0)) ** (1 / 3)
    for mark in np.arange(-2.0, 2.1, 0.5):
        canvas.line((mark, track - 0.03), (mark, track - 0.07), 0.012, GRID)
    canvas.line((-2.4, track), (2.4, track), 0.03, GRID)
    for end in (-2.4, 2.4):
        canvas.line((end, track - 0.07), (end, track + 0.23), 0.03, INK)
    width, height = 0.4 * bulk, 0.2 * bulk
    pivot = x, track + 0.015 + height / 2
    canvas.draw.rounded_rectangle(canvas.box(pivot, (width, height)), 0.04 * ZOOM, CART)
    tip = x + length * np.sin(angle), pivot[1] + length * np.cos(angle)
    canvas.line(pivot, tip, 0.07 * bulk, BODY)
    canvas.disc(pivot, 0.028, PAPER)
    if abs(push) > 0.02:
        start = x + np.sign(push) * (width / 2 + 0.05)
        canvas.line((start, pivot[1]), (start + 0.5 * push, pivot[1]), 0.03, FORCE)
        canvas.arrow_head((start + 0.5 * push, pivot[1]), (np.sign(push), 0.0))
    return canvas.frame()


def pendulum(state: np.ndarray, torque: float, sim_params: Mapping[str, float]) -> np.ndarray:
    """Draw a rod of its true length that turns around the middle, and an arc for the torque."""
    canvas, origin, radius = _Canvas(), (0.0, 0.0), 0.26
    angle, length = state[0], sim_params["length"]
    torque = torque * sim_params["gain"] / PendulumTask.action_high[0]
    for distance in (0.5, 1.0, 1.5):
        canvas.disc(origin, distance, GRID, outline=SCALE)
    canvas.line((0.0, 1.6), (0.0, 1.85), 0.012, GRID)
    canvas.line(origin, (-length * np.sin(angle), length * np.cos(angle)), 0.13, BODY)
    canvas.disc(origin, 0.035, INK)
    if abs(torque) > 0.02:  # an arc from the top; Pillow's degrees go clockwise from the right
        ends = sorted((-90.0, -90.0 - 150.0 * torque))
        box = canvas.box(origin, (2 * radius, 2 * radius))
        canvas.draw.arc(box, ends[0], ends[1], FORCE, round(0.03 * ZOOM))
        end = np.deg2rad(90.0 + 150.0 * torque)
        radial = np.array([np.cos(end), np.sin(end)])
        along = np.sign(torque) * np.array([-radial[1], radial[0]])
        canvas.arrow_head((radius - 0.015) * radial, along)
    return canvas.frame()


DRAWINGS = {"cartpole-swingup": cart_pole, "pendulum": pendulum}
"""Drawings of a state, the action that led to it, and the physics, by the world's name."""


def restyle(spec: Any) -> None:
    """Give an `MjSpec` a pale floor and sky; its physics does not change."""
    import mujoco

    for texture in spec.textures:
        if texture.type == mujoco.mjtTexture.mjTEXTURE_SKYBOX:
            texture.rgb1, texture.rgb2 = (0.70, 0.79, 0.88), (0.95, 0.96, 0.97)
        elif texture.type == mujoco.mjtTexture.mjTEXTURE_2D:
            texture.rgb1, texture.rgb2 = (0.62, 0.64, 0.65), (0.74, 0.75, 0.75)
    for material in spec.materials:
        material.reflectance, material.specular = 0.0, 0.1
        material.texrepeat = (0.75, 0.75)  # tiles per metre of the floor
    for light in spec.lights:
        light.diffuse, light.specular = (0.55, 0.55, 0.55), (0.15, 0.15, 0.15)
        light.dir = (0.15, 0.25, -1.0)
    spec.visual.headlight.ambient = (0.42, 0.42, 0.42)
    spec.visual.headlight.diffuse = (0.32, 0.32, 0.32)


def paint(model: Any) -> None:
    """Colour the torso of an `MjModel` blue and the limbs orange; draw its floor without end."""
    torso, near, far = (0.20, 0.40, 0.64, 1.0), (0.80, 0.47, 0.24, 1.0), (0.62, 0.33, 0.16, 1.0)
    for geom in range(model.ngeom):
        body = model.geom_bodyid[geom]
        if body == 0:
            model.geom_rgba[geom] = 1.0
            model.geom_size[geom, :2] = 0.0  # without end, as it is to physics: robots run far
            continue
        behind = model.body(body).name.startswith(("left", "fthigh", "fshin", "ffoot"))
        model.geom_matid[geom] = -1
        model.geom_rgba[geom] = torso if body == 1 else far if behind else near


class RobotRenderer:
    """Draws the states of one `MjModel`.

    MuJoCo's own `Renderer` binds itself to one OpenGL library when `mujoco` is imported, by
    default to one that needs a screen; this one chooses when the first frame is asked for:
    the library that `MUJOCO_GL` names, else EGL if installed, else OSMesa.

    Args:
        model: An `MjModel`.
        camera: Its distance (m), its elevation (degrees), and the height that it looks at (m).

    Raises:
        BadEnvironmentError: No OpenGL library for drawing without a screen was found.
    """

    def __init__(self, model: Any, camera: tuple[float, float, float]):
        import mujoco

        model.vis.global_.offwidth, model.vis.global_.offheight = WIDTH, HEIGHT
        library = opengl_library()
        try:
            self._context = importlib.import_module(f"mujoco.{library}").GLContext(WIDTH, HEIGHT)
            self._context.make_current()
            size = mujoco.mjtFontScale.mjFONTSCALE_100.value
            self._mjr = mujoco.MjrContext(model, size)
        except Exception as error:  # each library fails with errors of its own
            reason = f"{type(error).__name__} {error}".splitlines()[0]
            raise BadEnvironmentError(
                f"cannot draw without a screen: {library} failed ({reason}); on Debian, `apt-get"
                " install libegl1 libgl1` (or libosmesa6), and leave MUJOCO_GL unset or set it to"
                " egl or osmesa."
            ) from error
        mujoco.mjr_setBuffer(mujoco.mjtFramebuffer.mjFB_OFFSCREEN.value, self._mjr)
        self._scene = mujoco.MjvScene(model, maxgeom=1000)
        self._options, self._view = mujoco.MjvOption(), mujoco.MjvCamera()
        self._view.distance, self._view.elevation, self._height = camera
        self._view.azimuth = 90.0

    def frame(self, model: Any, data: Any) -> np.ndarray:
        """Draw the state of an `MjData` as `uint8` [height, width, 3]; it is not changed."""
        import mujoco

        mujoco.mj_kinematics(model, data)
        mujoco.mj_comPos(model, data)
        mujoco.mj_camlight(model, data)
        torso = data.xpos[1]
        data.light_xpos[:, :2] = torso[:2] - (0.6, 1.0)
        data.light_xpos[:, 2] = 4.0
        self._view.lookat[:] = torso[0], torso[1], self._height
        self._context.make_current()
        view = self._options, None, self._view, mujoco.mjtCatBit.mjCAT_ALL.value
        mujoco.mjv_updateScene(model, data, *view, self._scene)
        window = mujoco.MjrRect(0, 0, WIDTH, HEIGHT)
        mujoco.mjr_render(window, self._scene, self._mjr)
        pixels = np.empty((HEIGHT, WIDTH, 3), np.uint8)
        mujoco.mjr_readPixels(pixels, None, window, self._mjr)
        return pixels[::-1].copy()

    def close(self) -> None:
        """Free what OpenGL holds."""
        self._context.make_current()
        self._mjr.free()
        self._context.free()


def opengl_library() -> str:
    """Return the OpenGL library to draw with: `"egl"`, `"osmesa"` or MuJoCo's own choice."""
    chosen = os.environ.get("MUJOCO_GL", "").strip().lower()
    if not chosen and sys.platform.startswith("linux"):
        return "egl" if ctypes.util.find_library("EGL") else "osmesa"
    return chosen if chosen in ("egl", "osmesa") else "gl_context"
