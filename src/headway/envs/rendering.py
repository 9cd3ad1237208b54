"""Drawing MuJoCo scenes without a screen, through EGL or OSMesa."""

import ctypes.util
import dataclasses
import importlib
import os
import sys
from typing import Any

import mujoco
import numpy as np

from headway.errors import EnvironmentFault

WIDTH, HEIGHT = 640, 480
_LIBRARIES = {"egl": "EGL", "osmesa": "OSMesa"}


@dataclasses.dataclass(frozen=True)
class Camera:
    """A camera that follows the robot from the side."""

    distance: float
    elevation: float
    height: float
    azimuth: float = 90.0


class OffscreenRenderer:
    """Draws the states of one model.

    MuJoCo's own `Renderer` binds itself to one OpenGL library when `mujoco` is imported, by
    default to one that needs a screen; this one chooses when the first frame is asked for:
    the library that `MUJOCO_GL` names, else EGL if installed, else OSMesa.
    """

    def __init__(self, model: mujoco.MjModel, camera: Camera):
        self._context: Any = _new_context()
        self._context.make_current()
        model.vis.global_.offwidth, model.vis.global_.offheight = WIDTH, HEIGHT
        self._mjr = mujoco.MjrContext(model, mujoco.mjtFontScale.mjFONTSCALE_100.value)
        mujoco.mjr_setBuffer(mujoco.mjtFramebuffer.mjFB_OFFSCREEN.value, self._mjr)
        self._scene = mujoco.MjvScene(model, maxgeom=1000)
        self._options = mujoco.MjvOption()
        self._camera, self._view = camera, mujoco.MjvCamera()
        self._view.distance, self._view.elevation = camera.distance, camera.elevation
        self._view.azimuth = camera.azimuth

    def frame(self, model: mujoco.MjModel, data: mujoco.MjData) -> np.ndarray:
        """Draw the present state as `uint8` [height, width, 3]; the state is not changed."""
        mujoco.mj_kinematics(model, data)
        mujoco.mj_comPos(model, data)
        mujoco.mj_camlight(model, data)
        torso = data.xpos[1]
        self._view.lookat[:] = torso[0], torso[1], self._camera.height
        self._context.make_current()
        mujoco.mjv_updateScene(
            model,
            data,
            self._options,
            None,
            self._view,
            mujoco.mjtCatBit.mjCAT_ALL.value,
            self._scene,
        )
        view = mujoco.MjrRect(0, 0, WIDTH, HEIGHT)
        mujoco.mjr_render(view, self._scene, self._mjr)
        pixels = np.empty((HEIGHT, WIDTH, 3), np.uint8)
        mujoco.mjr_readPixels(pixels, None, view, self._mjr)
        return pixels[::-1].copy()

    def close(self) -> None:
        """Free what OpenGL holds."""
        self._context.make_current()
        self._mjr.free()
        self._context.free()


def opengl_library() -> str:
    """Return the OpenGL library to draw with: `"egl"`, `"osmesa"` or MuJoCo's choice.

    Raises:
        EnvironmentFault: None is installed.
    """
    chosen = os.environ.get("MUJOCO_GL", "").strip().lower()
    if chosen or not sys.platform.startswith("linux"):
        return chosen or "default"
    for name, library in _LIBRARIES.items():
        if ctypes.util.find_library(library):
            return name
    raise _no_opengl("neither EGL nor OSMesa is installed")


def _new_context() -> Any:
    """Make an OpenGL context without a window."""
    library = opengl_library()
    name = f"mujoco.{library}" if library in _LIBRARIES else "mujoco.gl_context"
    try:
        return importlib.import_module(name).GLContext(WIDTH, HEIGHT)
    except Exception as error:  # each library fails with errors of its own
        reason = str(error).splitlines()[0] if str(error) else type(error).__name__
        raise _no_opengl(f"{library} failed: {reason}") from error


def _no_opengl(reason: str) -> EnvironmentFault:
    return EnvironmentFault(
        f"cannot draw without a screen: {reason}; on Debian, `apt-get install libegl1 libgl1` (or"
        " libosmesa6), and leave MUJOCO_GL unset or set it to egl or osmesa."
    )
