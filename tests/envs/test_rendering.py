"""Pictures without a screen."""

import ctypes.util
import sys

import numpy as np
import pytest
from env_helpers import NAMES, ROBOTS, actions_of

from headway import envs
from headway.errors import BadEnvironmentError
from headway.task import env_spec
from headway.worlds import rendering

HAS_OPENGL = any(ctypes.util.find_library(name) for name in ("EGL", "OSMesa"))
needs_opengl = pytest.mark.skipif(not HAS_OPENGL, reason="no EGL or OSMesa library installed")
PICTURED = [pytest.param(n, marks=needs_opengl if n in ROBOTS else ()) for n in NAMES]


@pytest.mark.parametrize("name", PICTURED)
def test_frames_show_the_state_and_change_nothing(name):
    env, plain = envs.make(name, render_mode="rgb_array"), envs.make(name)
    first_obs, _ = env.reset(seed=0)
    np.testing.assert_array_equal(plain.reset(seed=0)[0], first_obs)
    first = env.render()
    assert (first.shape, first.dtype) == ((480, 640, 3), np.uint8)
    assert first.std() > 5  # something is drawn
    for action in actions_of(name, "extreme", 12):
        np.testing.assert_array_equal(env.step(action)[0], plain.step(action)[0])
    assert np.abs(env.render().astype(int) - first).max() > 50  # and it moved
    assert plain.unwrapped.render() is None
    env.close()


@pytest.mark.parametrize("name", rendering.DRAWINGS)
def test_drawings_show_what_acts_not_what_was_asked_for(name):
    draw, physics = rendering.DRAWINGS[name], dict(env_spec(name).default_sim_params)
    state, turned = np.array([0.5, 0.0, 3.0, 0.0]), physics | {"gain": -1.0}
    np.testing.assert_array_equal(draw(state, 0.8, turned), draw(state, -0.8, physics))


@needs_opengl
def test_the_camera_follows():
    env = envs.make("half-cheetah", render_mode="rgb_array")
    env.reset(seed=0)
    state = env.unwrapped.get_state()
    state[0] += 50.0
    env.unwrapped.set_state(state)
    frame = env.render().astype(int)
    blue = (frame[..., 2] - frame[..., 0]) > 60  # the torso
    columns = np.flatnonzero(blue.any(0))
    assert 150 < columns.mean() < 490
    env.close()


def test_the_error_names_the_package(monkeypatch):
    monkeypatch.setenv("MUJOCO_GL", "osmesa")
    monkeypatch.setitem(sys.modules, "mujoco.osmesa", None)  # cannot be imported
    env = envs.make("hopper", render_mode="rgb_array")
    env.reset(seed=0)
    with pytest.raises(BadEnvironmentError, match="apt-get install libegl1") as caught:
        env.render()
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("chosen", "installed", "library"),
    [("", "libEGL.so", "egl"), ("", None, "osmesa"), ("OSMesa", "libEGL.so", "osmesa")],
)
def test_choice_of_library(monkeypatch, chosen, installed, library):
    monkeypatch.setenv("MUJOCO_GL", chosen)
    monkeypatch.setattr(rendering.sys, "platform", "linux")
    monkeypatch.setattr(rendering.ctypes.util, "find_library", lambda name: installed)
    assert rendering.opengl_library() == library
