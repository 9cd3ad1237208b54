# pyright: reportAttributeAccessIssue=false
# (the names compiled into mujoco have no stubs)

"""The four MuJoCo robots: what is observed, what is paid, and what their physics means.

All formulas are NumPy on arrays with any number of leading axes. The models are the XML
files that Gymnasium ships.
"""

import abc
import copy
import functools
import importlib.util
from collections.abc import Mapping
from pathlib import Path
from typing import Any, ClassVar, NamedTuple

import mujoco
import numpy as np

from headway.envs.rendering import GREY, Camera, paint, restyle
from headway.envs.world import World
from headway.errors import BrokenEpisodeError
from headway.sim_params import SimParamSets
from headway.tasks.base import Task
from headway.tasks.locomotion import (
    CrippledAntTask,
    HalfCheetahTask,
    HopperTask,
    SlimHumanoidTask,
)


class RobotState(NamedTuple):
    """State of one or many robots."""

    qpos: np.ndarray
    qvel: np.ndarray
    velocity: np.ndarray
    """Average forward velocity over the control step that led here (m/s); 0 at reset."""


class Robot(World):
    """A robot that is paid for moving forward."""

    obs_dtype = np.float64
    xml: ClassVar[str]
    frame_skip: ClassVar[int]
    camera: ClassVar[Camera]

    def __init__(self, task: Task, sim_params: SimParamSets | None):
        super().__init__(task, sim_params)
        self.nominal = load_model(self.xml)
        self.time_step = self.frame_skip * self.nominal.opt.timestep

    def new_model(self) -> mujoco.MjModel:
        """Return a copy of the unchanged robot."""
        return copy.copy(self.nominal)

    @abc.abstractmethod
    def initial_state(self, rng: np.random.Generator) -> RobotState:
        """Draw the state that an episode starts in."""

    @abc.abstractmethod
    def set_physics(self, model: mujoco.MjModel, sim_params: Mapping[str, float]) -> None:
        """Give a model the physics of some simulator parameters."""

    def control(self, action: np.ndarray, sim_params: Mapping[str, Any]) -> np.ndarray:
        """Return what the actuators receive."""
        del sim_params
        return action

    @abc.abstractmethod
    def observe(self, state: RobotState) -> np.ndarray:
        """Return the observation [..., obs] of a state."""

    @abc.abstractmethod
    def reward(self, before: RobotState, action: np.ndarray, after: RobotState) -> np.ndarray:
        """Return the reward of a step."""

    def after_step(self, before: RobotState, qpos: np.ndarray, qvel: np.ndarray) -> RobotState:
        """Assemble the state that a step led to."""
        velocity = (qpos[..., 0] - before.qpos[..., 0]) / self.time_step
        return RobotState(qpos, qvel, velocity)

    def warning(self, data: mujoco.MjData) -> str:
        """What MuJoCo warns of, or nothing: non-finite or huge numbers, or full buffers.

        It would quietly start over from the nominal state.
        """
        counts = data.warning.number
        if not counts.any():
            return ""
        name = mujoco.mjtWarning(int(np.argmax(counts))).name.removeprefix("mjWARN_")
        return f"the simulation of {self.name} diverged ({name})"

    def check_warnings(self, data: mujoco.MjData, sim_params: Mapping[str, Any]) -> None:
        """Notice that MuJoCo gave up on a state.

        Raises:
            BrokenEpisodeError: MuJoCo warned.
        """
        warning = self.warning(data)
        if warning:
            physics = {name: float(value) for name, value in sim_params.items()}
            raise BrokenEpisodeError(
                f"{warning} under sim_params {physics}, allowed: finite states; use less extreme"
                " sim_params."
            )


class ScaledRobot(Robot):
    """A robot whose masses and joint damping are scaled.

    As in the released code only `body_mass` and `dof_damping` change: rotational inertia and
    the constants that MuJoCo derives keep their values. `scale_inertia` scales
    `body_inertia` with the mass.
    """

    scale_inertia: bool

    def set_physics(self, model: mujoco.MjModel, sim_params: Mapping[str, float]) -> None:
        """Scale the nominal masses and damping."""
        mass = sim_params["mass_scale"]
        model.body_mass[:] = self.nominal.body_mass * mass
        model.dof_damping[:] = self.nominal.dof_damping * sim_params["damping_scale"]
        if self.scale_inertia:
            model.body_inertia[:] = self.nominal.body_inertia * mass


class Hopper(ScaledRobot):
    """Laws of `HopperEnv`."""

    name, xml, frame_skip = "hopper", "hopper.xml", 4
    camera = Camera(distance=3.1, elevation=-8.0, height=0.75)

    def __init__(
        self,
        sim_params: SimParamSets | None = None,
        *,
        scale_inertia: bool = False,
        observe_average_velocity: bool = True,
    ):
        super().__init__(HopperTask(scale_inertia, observe_average_velocity), sim_params)
        self.scale_inertia = scale_inertia
        self.observe_average_velocity = observe_average_velocity

    def initial_state(self, rng: np.random.Generator) -> RobotState:
        """Uniform noise of ±0.005 on positions and velocities."""
        qpos = self.nominal.qpos0 + rng.uniform(-0.005, 0.005, self.nominal.nq)
        return RobotState(qpos, rng.uniform(-0.005, 0.005, self.nominal.nv), np.zeros(()))

    def observe(self, state: RobotState) -> np.ndarray:
        """Return positions but x, clipped velocities, and the average forward velocity."""
        parts = [state.qpos[..., 1:], np.clip(state.qvel, -10.0, 10.0)]
        if self.observe_average_velocity:
            parts.append(state.velocity[..., None])
        return np.concatenate(parts, axis=-1)

    def reward(self, before: RobotState, action: np.ndarray, after: RobotState) -> np.ndarray:
        """Forward velocity, 1 for being alive, and a small price of effort."""
        del before
        return after.velocity + 1.0 - 1e-3 * np.square(action).sum(-1)


class SlimHumanoid(ScaledRobot):
    """Laws of `SlimHumanoidEnv`."""

    name, xml, frame_skip = "slim-humanoid", "humanoid.xml", 5
    camera = Camera(distance=3.6, elevation=-8.0, height=0.9)

    def __init__(self, sim_params: SimParamSets | None = None, *, scale_inertia: bool = False):
        super().__init__(SlimHumanoidTask(scale_inertia), sim_params)
        self.scale_inertia = scale_inertia

    def initial_state(self, rng: np.random.Generator) -> RobotState:
        """Uniform noise of ±0.01 on positions and velocities; the quaternion normalised."""
        qpos = self.nominal.qpos0 + rng.uniform(-0.01, 0.01, self.nominal.nq)
        qvel = rng.uniform(-0.01, 0.01, self.nominal.nv)
        return RobotState(_with_unit_quaternion(qpos), qvel, np.zeros(()))

    def observe(self, state: RobotState) -> np.ndarray:
        """Return positions but x and y, and velocities."""
        return np.concatenate([state.qpos[..., 2:], state.qvel], axis=-1)

    def reward(self, before: RobotState, action: np.ndarray, after: RobotState) -> np.ndarray:
        """Forward velocity before the step, effort, and 5 for standing after it."""
        height = after.qpos[..., 2]
        standing = (height >= 1.0) & (height <= 2.0)
        effort = np.square(action).sum(-1)
        return 0.25 / 0.015 * before.qvel[..., 0] - 0.1 * effort + 5.0 * standing


class HalfCheetah(ScaledRobot):
    """Laws of `HalfCheetahEnv`."""

    name, xml, frame_skip = "half-cheetah", "half_cheetah.xml", 5
    camera = Camera(distance=2.9, elevation=-12.0, height=0.45)

    def __init__(self, sim_params: SimParamSets | None = None, *, scale_inertia: bool = False):
        super().__init__(HalfCheetahTask(scale_inertia), sim_params)
        self.scale_inertia = scale_inertia

    def initial_state(self, rng: np.random.Generator) -> RobotState:
        """Normal noise with standard deviation 0.001 on positions and velocities."""
        qpos = self.nominal.qpos0 + rng.normal(0.0, 0.001, self.nominal.nq)
        return RobotState(qpos, rng.normal(0.0, 0.001, self.nominal.nv), np.zeros(()))

    def observe(self, state: RobotState) -> np.ndarray:
        """Return the average forward velocity, positions but x, and velocities."""
        return np.concatenate([state.velocity[..., None], state.qpos[..., 1:], state.qvel], -1)

    def reward(self, before: RobotState, action: np.ndarray, after: RobotState) -> np.ndarray:
        """Forward velocity and the price of effort."""
        del before
        return after.velocity - 0.1 * np.square(action).sum(-1)


class CrippledAnt(Robot):
    """Laws of `CrippledAntEnv`."""

    name, xml, frame_skip = "crippled-ant", "ant.xml", 5
    camera = Camera(distance=3.4, elevation=-40.0, height=0.3)
    choices: ClassVar[Mapping[str, tuple[float, ...]]] = {"crippled_leg": (-1, 0, 1, 2, 3)}
    leg_geoms = (
        ("left_leg_geom", "left_ankle_geom"),
        ("right_leg_geom", "right_ankle_geom"),
        ("back_leg_geom", "third_ankle_geom"),
        ("rightback_leg_geom", "fourth_ankle_geom"),
    )
    """Upper and lower part of each leg."""

    def __init__(self, sim_params: SimParamSets | None = None, *, shrink_leg: bool = False):
        super().__init__(CrippledAntTask(shrink_leg), sim_params)
        self.shrink_leg = shrink_leg
        legs = np.array([1, 2, 3, 0])  # leg i obeys the i-th of these pairs of actuators
        # The last row serves leg -1: all legs obey.
        self._mask = np.vstack([np.repeat(np.arange(4) != pair, 2) for pair in [*legs, -1]])

    def initial_state(self, rng: np.random.Generator) -> RobotState:
        """Noise U(±0.1) on positions, 0.1 N(0, 1) on velocities; the quaternion normalised."""
        qpos = self.nominal.qpos0 + rng.uniform(-0.1, 0.1, self.nominal.nq)
        qvel = 0.1 * rng.standard_normal(self.nominal.nv)
        return RobotState(_with_unit_quaternion(qpos), qvel, np.zeros(()))

    def set_physics(self, model: mujoco.MjModel, sim_params: Mapping[str, float]) -> None:
        """Colour the crippled leg and, if asked for, halve its capsules."""
        for name in ("geom_size", "geom_pos", "geom_rgba"):
            getattr(model, name)[:] = getattr(self.nominal, name)
        leg = int(sim_params["crippled_leg"])
        if leg < 0:
            return
        upper, lower = (model.geom(name).id for name in self.leg_geoms[leg])
        model.geom_rgba[[upper, lower]] = GREY
        if self.shrink_leg:
            model.geom_size[[upper, lower]] *= 0.5
            model.geom_pos[lower] = model.geom_pos[upper]

    def control(self, action: np.ndarray, sim_params: Mapping[str, Any]) -> np.ndarray:
        """Silence the two motors of the crippled leg."""
        return action * self._mask[np.asarray(sim_params["crippled_leg"], int)]

    def observe(self, state: RobotState) -> np.ndarray:
        """Return positions, velocities, the torso's rotation matrix and its position."""
        rotation = _rotation_matrix(state.qpos[..., 3:7])
        return np.concatenate([state.qpos, state.qvel, rotation, state.qpos[..., :3]], axis=-1)

    def reward(self, before: RobotState, action: np.ndarray, after: RobotState) -> np.ndarray:
        """Forward velocity and a constant; effort is free."""
        del before, action
        return after.velocity + 0.05


def _with_unit_quaternion(qpos: np.ndarray) -> np.ndarray:
    """Normalise the free joint's quaternion, as MuJoCo 2.0 did in place."""
    qpos[3:7] /= np.linalg.norm(qpos[3:7])
    return qpos


def _rotation_matrix(quaternion: np.ndarray) -> np.ndarray:
    """Return the row-major rotation matrix [..., 9] of unit quaternions (w, x, y, z)."""
    w, x, y, z = np.moveaxis(quaternion, -1, 0)
    rows = (
        (w * w + x * x - y * y - z * z, 2 * (x * y - w * z), 2 * (x * z + w * y)),
        (2 * (x * y + w * z), w * w - x * x + y * y - z * z, 2 * (y * z - w * x)),
        (2 * (x * z - w * y), 2 * (y * z + w * x), w * w - x * x - y * y + z * z),
    )
    return np.stack([entry for row in rows for entry in row], axis=-1)


@functools.cache
def load_model(xml: str) -> mujoco.MjModel:
    """Compile one of Gymnasium's MuJoCo models.

    The half cheetah asks the compiler for a total mass, which MuJoCo deprecates with a
    warning on the terminal; the same is done here after compiling.
    """
    found = importlib.util.find_spec("gymnasium")
    assert found is not None
    assert found.origin is not None
    path = Path(found.origin).parent / "envs" / "mujoco" / "assets" / xml
    spec = mujoco.MjSpec.from_file(str(path))
    total_mass = spec.compiler.settotalmass
    spec.compiler.settotalmass = -1
    restyle(spec)
    model = spec.compile()
    paint(model)
    if total_mass > 0:
        mujoco.mj_setTotalmass(model, total_mass)
        mujoco.mj_setConst(model, mujoco.MjData(model))
    return model
