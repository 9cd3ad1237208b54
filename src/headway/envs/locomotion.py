# pyright: reportAttributeAccessIssue=false
# (the names compiled into mujoco have no stubs)

"""Hopper, SlimHumanoid, HalfCheetah and CrippledAnt, stepped one at a time by MuJoCo."""

from typing import Any

import mujoco
import numpy as np

from headway.envs.rendering import OffscreenRenderer
from headway.envs.robots import (
    CrippledAnt,
    HalfCheetah,
    Hopper,
    Robot,
    RobotState,
    SlimHumanoid,
)
from headway.envs.world import WorldEnv, check_state
from headway.sim_params import SimParamSets


class LocomotionEnv(WorldEnv):
    """One robot with a MuJoCo model of its own."""

    _world: Robot

    def __init__(self, robot: Robot, render_mode: str | None):
        super().__init__(robot, render_mode)
        self.metadata = self.metadata | {"render_fps": round(1 / robot.time_step)}
        self.model = robot.new_model()
        self.data = mujoco.MjData(self.model)
        self._velocity = 0.0
        self._renderer: OffscreenRenderer | None = None
        self._apply_sim_params()

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        """Make one control step; actions beyond their bounds are clipped.

        Raises:
            ConfigError: The action has the wrong shape or is not finite.
            BrokenEpisodeError: The simulation diverged.
        """
        robot, data = self._world, self.data
        action = robot.clip(action, (self.model.nu,))
        self._begin_step()
        before = self._robot_state()
        data.ctrl[:] = robot.control(action, self._sim_params)
        mujoco.mj_step(self.model, data, nstep=robot.frame_skip)
        robot.check_warnings(data, self._sim_params)
        after = robot.after_step(before, data.qpos.copy(), data.qvel.copy())
        self._velocity = float(after.velocity)
        reward = float(robot.reward(before, action, after))
        return robot.observe(after), reward, False, False, self._info()

    def observation(self) -> np.ndarray:
        """Return the observation of the present state."""
        return self._world.observe(self._robot_state())

    def get_state(self) -> np.ndarray:
        """Return positions, velocities, the solver's warm start, and the average velocity."""
        data = self.data
        return np.concatenate([data.qpos, data.qvel, data.qacc_warmstart, [self._velocity]])

    def set_state(self, state: np.ndarray) -> None:
        """Go to a state that `get_state` returned.

        Raises:
            ConfigError: The state has the wrong size or is not finite.
        """
        nq, nv = self.model.nq, self.model.nv
        state = check_state(self._world.name, state, nq + 2 * nv + 1)
        self.data.warning.number[:] = 0  # they are of where it was before
        parts = np.split(state, [nq, nq + nv, nq + 2 * nv])
        self.data.qpos[:], self.data.qvel[:], self.data.qacc_warmstart[:] = parts[:3]
        self._velocity = float(parts[3][0])

    def render(self) -> np.ndarray | None:  # pyright: ignore[reportIncompatibleMethodOverride]
        """Draw the present state, if `render_mode` is `"rgb_array"`.

        Raises:
            BadEnvironmentError: No OpenGL library for drawing without a screen was found.
        """
        if self.render_mode is None:
            return None
        if self._renderer is None:
            self._renderer = OffscreenRenderer(self.model, self._world.camera)
        return self._renderer.frame(self.model, self.data)

    def close(self) -> None:
        """Free the renderer."""
        if self._renderer is not None:
            self._renderer.close()
            self._renderer = None

    def _robot_state(self) -> RobotState:
        velocity = np.float64(self._velocity)
        return RobotState(self.data.qpos.copy(), self.data.qvel.copy(), np.asarray(velocity))

    def _reset_state(self) -> None:
        state = self._world.initial_state(self.np_random)
        mujoco.mj_resetData(self.model, self.data)
        self.data.qpos[:], self.data.qvel[:] = state.qpos, state.qvel
        self._velocity = float(state.velocity)

    def _apply_sim_params(self) -> None:
        self._world.set_physics(self.model, self._sim_params)


class HopperEnv(LocomotionEnv):
    """Hop forward on one leg with unknown masses; falling ends nothing.

    | What | Value |
    | --- | --- |
    | observation | 0 z, 1 torso pitch, 2 thigh, 3 leg, 4 foot angle; 5 ẋ, 6 ż, 7 pitch rate, |
    | | 8-10 joint rates, these clipped to ±10; 11 (x - x_before) / 0.008, 0 at reset |
    | action | torques of thigh, leg, foot in units of 200 N m, [-1, 1] |
    | reward | (x' - x) / 0.008 + 1 - 0.001 Σ a² |
    | sim_params | `mass_scale` of all bodies, `damping_scale` of all joints |
    | reset | nominal + U(±0.005) |
    | end | after 500 steps |
    | step | 4 × 0.002 s, RK4 |
    | options | `scale_inertia`: the mass scale applies to the rotational inertia too; |
    | | `observe_average_velocity=False`: the released code's 11 numbers |

    Source: supplement A.1 and released `hopper_env.py`; entry 11 is ours, since the reward
    cannot be told from the other 11.
    """

    def __init__(
        self,
        *,
        scale_inertia: bool = False,
        observe_average_velocity: bool = True,
        sim_params: SimParamSets | None = None,
        render_mode: str | None = None,
    ):
        robot = Hopper(
            sim_params,
            scale_inertia=scale_inertia,
            observe_average_velocity=observe_average_velocity,
        )
        super().__init__(robot, render_mode)


class SlimHumanoidEnv(LocomotionEnv):
    """Walk forward upright as a humanoid with unknown masses; falling ends nothing.

    | What | Value |
    | --- | --- |
    | observation | 0 z, 1-4 torso quaternion, 5-21 joint angles; 22-24 torso velocity, |
    | | 25-27 torso angular velocity, 28-44 joint rates |
    | action | 17 motors, [-0.4, 0.4] |
    | reward | (0.25 / 0.015) ẋ - 0.1 Σ a² + 5 [1 ≤ z' ≤ 2]; ẋ before, z' after the step |
    | sim_params | `mass_scale` of all bodies, `damping_scale` of all joints |
    | reset | nominal + U(±0.01), quaternion normalised |
    | end | after 1000 steps |
    | step | 5 × 0.003 s, RK4 |
    | options | `scale_inertia`: the mass scale applies to the rotational inertia too |

    Source: supplement A.1 and released `slim_humanoid_env.py`.
    """

    def __init__(
        self,
        *,
        scale_inertia: bool = False,
        sim_params: SimParamSets | None = None,
        render_mode: str | None = None,
    ):
        super().__init__(SlimHumanoid(sim_params, scale_inertia=scale_inertia), render_mode)


class HalfCheetahEnv(LocomotionEnv):
    """Run forward with unknown masses.

    | What | Value |
    | --- | --- |
    | observation | 0 (x - x_before) / 0.05, 0 at reset; 1 z, 2 pitch, 3-8 joint angles; |
    | | 9 ẋ, 10 ż, 11 pitch rate, 12-17 joint rates |
    | action | torques of 3 back and 3 front joints, [-1, 1] |
    | reward | (x' - x) / 0.05 - 0.1 Σ a² |
    | sim_params | `mass_scale` of all bodies, `damping_scale` of all joints |
    | reset | nominal + N(0, 0.001) |
    | end | after 1000 steps |
    | step | 5 × 0.01 s, Euler |
    | options | `scale_inertia`: the mass scale applies to the rotational inertia too |

    Source: supplement A.1 and released `half_cheetah_env.py`.
    """

    def __init__(
        self,
        *,
        scale_inertia: bool = False,
        sim_params: SimParamSets | None = None,
        render_mode: str | None = None,
    ):
        super().__init__(HalfCheetah(sim_params, scale_inertia=scale_inertia), render_mode)


class CrippledAntEnv(LocomotionEnv):
    """Walk on four legs, one of which does not obey.

    | What | Value |
    | --- | --- |
    | observation | 0-2 x, y, z, 3-6 quaternion, 7-14 joint angles; 15-28 velocities; |
    | | 29-37 rotation matrix of the torso, 38-40 its position |
    | action | hip and ankle of legs 3, 0, 1, 2 (in this order), [-1, 1] |
    | reward | (x' - x) / 0.05 + 0.05 |
    | sim_params | `crippled_leg`: 0 front left, 1 front right, 2 and 3 the back legs, -1 none |
    | reset | positions nominal + U(±0.1), quaternion normalised; velocities 0.1 N(0, 1) |
    | end | after 1000 steps |
    | step | 5 × 0.01 s, RK4 |
    | options | `shrink_leg`: the crippled leg is also half as long and thick |

    Source: supplement A.1 and released `ant_cripple_env.py`; `shrink_leg` is the original of
    learning_to_adapt. The torso's pose is taken from the state after the step.
    """

    def __init__(
        self,
        *,
        shrink_leg: bool = False,
        sim_params: SimParamSets | None = None,
        render_mode: str | None = None,
    ):
        super().__init__(CrippledAnt(sim_params, shrink_leg=shrink_leg), render_mode)
