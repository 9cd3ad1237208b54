# pyright: reportAttributeAccessIssue=false
# (the names compiled into mujoco have no stubs)

"""Drawing MuJoCo scenes without a screen, through EGL or OSMesa."""

import ctypes.util
import dataclasses
import importlib
import os
import sys
from typing import Any

import mujoco
import numpy as np

from headway.errors import BadEnvironmentError

WIDTH, HEIGHT = 640, 480
GREY = (0.42, 0.44, 0.47, 1.0)
_TORSO, _NEAR, _FAR = (0.20, 0.40, 0.64, 1.0), (0.80, 0.47, 0.24, 1.0), (0.62, 0.33, 0.16, 1.0)
_PALE, _PALER, _SKY = (0.62, 0.64, 0.65), (0.74, 0.75, 0.75), (0.70, 0.79, 0.88)
_LIBRARIES = {"egl": "EGL", "osmesa": "OSMesa"}


@dataclasses.dataclass(frozen=True)
class Camera:
    """A camera that follows the robot from the side."""

    distance: float
    elevation: float
    height: float
    azimuth: float = 90.0


def restyle(spec: mujoco.MjSpec) -> None:
    """Give a model a pale floor and sky; its physics does not change."""
    for texture in spec.textures:
        if texture.type == mujoco.mjtTexture.mjTEXTURE_SKYBOX:
            texture.rgb1, texture.rgb2 = _SKY, (0.95, 0.96, 0.97)
        elif texture.type == mujoco.mjtTexture.mjTEXTURE_2D:
            texture.rgb1, texture.rgb2 = _PALE, _PALER
    for material in spec.materials:
        material.reflectance = 0.0
        material.specular = 0.1
    for light in spec.lights:
        light.diffuse = (0.55, 0.55, 0.55)
        light.specular = (0.15, 0.15, 0.15)
        light.dir = (0.15, 0.25, -1.0)
    spec.visual.headlight.ambient = (0.42, 0.42, 0.42)
    spec.visual.headlight.diffuse = (0.32, 0.32, 0.32)


def paint(model: mujoco.MjModel) -> None:
    """Colour the torso blue and the limbs orange, those of the far side darker."""
    for geom in range(model.ngeom):
        body = model.geom_bodyid[geom]
        name = model.body(body).name
        if body == 0:
            model.geom_rgba[geom] = 1.0
            continue
        far = name.startswith(("left", "fthigh", "fshin", "ffoot"))
        model.geom_matid[geom] = -1
        model.geom_rgba[geom] = _TORSO if body == 1 else _FAR if far else _NEAR


class OffscreenRenderer:
    """Draws the states of one model.

    MuJoCo's own `Renderer` binds itself to one OpenGL library when `mujoco` is imported, by
    default to one that needs a screen; this one chooses when the first frame is asked for:
    the library that `MUJOCO_GL` names, else EGL if installed, else OSMesa.
    """

    def __init__(self, model: mujoco.MjModel, camera: Camera):
        model.vis.global_.offwidth, model.vis.global_.offheight = WIDTH, HEIGHT
        self._context, self._mjr = _new_contexts(model)
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
        data.light_xpos[:, :2] = torso[:2] - (0.6, 1.0)
        data.light_xpos[:, 2] = 4.0
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
        BadEnvironmentError: None is installed.
    """
    chosen = os.environ.get("MUJOCO_GL", "").strip().lower()
    if chosen or not sys.platform.startswith("linux"):
        return chosen or "default"
    for name, library in _LIBRARIES.items():
        if ctypes.util.find_library(library):
            return name
    raise _no_opengl("neither EGL nor OSMesa is installed")


def _new_contexts(model: mujoco.MjModel) -> tuple[Any, mujoco.MjrContext]:
    """Make an OpenGL context without a window, and MuJoCo's own inside it."""
    library = opengl_library()
    name = f"mujoco.{library}" if library in _LIBRARIES else "mujoco.gl_context"
    try:
        context = importlib.import_module(name).GLContext(WIDTH, HEIGHT)
        context.make_current()
        return context, mujoco.MjrContext(model, mujoco.mjtFontScale.mjFONTSCALE_100.value)
    except Exception as error:  # each library fails with errors of its own
        reason = str(error).splitlines()[0] if str(error) else type(error).__name__
        raise _no_opengl(f"{library} failed: {reason}") from error


def _no_opengl(reason: str) -> BadEnvironmentError:
    return BadEnvironmentError(
        f"cannot draw without a screen: {reason}; on Debian, `apt-get install libegl1 libgl1` (or"
        " libosmesa6), and leave MUJOCO_GL unset or set it to egl or osmesa."
    )
