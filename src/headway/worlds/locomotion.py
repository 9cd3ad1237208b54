# pyright: reportAttributeAccessIssue=false
# (the names compiled into mujoco have no stubs)

"""Hopper, SlimHumanoid, HalfCheetah and CrippledAnt: Task, laws and physics.

The formulas are NumPy on arrays with any number of leading axes. The models are the XML
files that Gymnasium ships; MuJoCo is imported when the first one is loaded.
"""

import functools
from collections.abc import Mapping
from importlib import resources
from typing import Any, ClassVar, NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from headway.sim_params import SimParamSets
from headway.task import Action, EnvSpec, Obs, Reward, Task
from headway.worlds.base import World

GREY = (0.42, 0.44, 0.47, 1.0)
"""Colour of a crippled leg."""


QUICK = {
    "collection.num_iterations": 10,
    "collection.num_episodes": 10,
    "fitting.epochs": 1,
    "fitting.min_updates": 4000,
    "evaluation.every": 10,
}
"""As many steps as the paper's; with fewer updates PETS learned nothing (results/README.md)."""
QUICK_OF_FALLERS = {**QUICK, "collection.num_episodes": 50, "collection.episode_length": 200}
"""The same steps in short episodes: who has fallen stays down, and most data would be of that."""


class RobotState(NamedTuple):
    """State of one or many robots."""

    qpos: np.ndarray
    qvel: np.ndarray
    velocity: np.ndarray
    """Average forward velocity over the control step that led here (m/s); 0 at reset."""


class Robot(World):
    """A robot that is paid for moving forward; subclasses write `observe(state)`."""

    obs_dtype = np.float64
    xml: ClassVar[str]
    frame_skip: ClassVar[int]
    camera: ClassVar[tuple[float, float, float]]
    """Distance (m), elevation (degrees) and height (m) of the view, which follows from the side."""
    start_noise: ClassVar[tuple[str, str, float]]
    """Noise of the first positions and velocities, `uniform` or `normal`, and its size."""
    alive, effort = 0.0, 0.0
    """Reward of every step, and price of the sum of squared actions."""

    def __init__(self, sim_params: SimParamSets | None = None, **options: bool):
        super().__init__(sim_params, **options)
        self.nominal = load_model(self.xml)
        self.time_step = self.frame_skip * self.nominal.opt.timestep

    def initial_state(self, rng: np.random.Generator) -> np.ndarray:
        """Draw positions and velocities that an episode starts with, at no average velocity."""
        positions, velocities, size = self.start_noise
        ends = {"uniform": (-size, size), "normal": (0.0, size)}
        moved = getattr(rng, positions)(*ends[positions], self.nominal.nq)
        qpos = self.nominal.qpos0 + moved
        if self.nominal.nq > self.nominal.nv:  # has a quaternion, which MuJoCo 2.0 normalised
            qpos[3:7] /= np.linalg.norm(qpos[3:7])
        qvel = getattr(rng, velocities)(*ends[velocities], self.nominal.nv)
        return np.concatenate([qpos, qvel, np.zeros(self.nominal.nv + 1)])

    def set_physics(self, model: Any, sim_params: Mapping[str, float]) -> None:
        """Scale the nominal masses and damping.

        As in the released code only `body_mass` and `dof_damping` change: rotational inertia
        and the constants that MuJoCo derives keep their values. The option `scale_inertia`
        scales `body_inertia` with the mass.
        """
        mass = sim_params["mass_scale"]
        model.body_mass[:] = self.nominal.body_mass * mass
        model.dof_damping[:] = self.nominal.dof_damping * sim_params["damping_scale"]
        if self.task.scale_inertia:
            model.body_inertia[:] = self.nominal.body_inertia * mass

    def control(self, action: np.ndarray, sim_params: Mapping[str, Any]) -> np.ndarray:
        """Return what the actuators receive."""
        return action

    def reward(self, before: RobotState, action: np.ndarray, after: RobotState) -> np.ndarray:
        """Return the reward [...] of a step: forward velocity, being alive, and effort."""
        return after.velocity + self.alive - self.effort * np.square(action).sum(-1)

    def after_step(self, before: np.ndarray, qpos: np.ndarray, qvel: np.ndarray) -> RobotState:
        """Assemble the state that a step led to, from positions `before` it and after it."""
        return RobotState(qpos, qvel, (qpos[..., 0] - before[..., 0]) / self.time_step)


def _mass_sets(train: tuple[float, ...], low: tuple[float, ...], high: tuple[float, ...]):
    """Sets of mass scales whose damping scale is always 1, as in the paper."""
    one = {"damping_scale": (1.0,)}
    unseen = {"low": {"mass_scale": low, **one}, "high": {"mass_scale": high, **one}}
    return SimParamSets({"mass_scale": train, **one}, unseen)


def _effort(action: Action) -> Reward:
    return jnp.square(action).sum(-1)


class HopperTask(Task):
    """Hop forward; falling ends nothing and costs nothing by itself.

    reward = (x' - x) / 0.008 + 1 - 0.001 Σ a².

    The position x is not observed, so the observation's last entry is the average forward
    velocity over the control step just done, (x' - x) / 0.008. It is predicted as it is, not
    as a difference, and is no feature, like HalfCheetah's first entry.

    With `observe_average_velocity=False` the observation has the released code's 11 entries;
    then the velocity at the end of the step, clipped to ±10 m/s, stands in for the average
    and `reward` only approximates what the environment pays.

    References:
        Supplement A.1; released `hopper_env.py`.
    """

    action_size = 3
    action_low, action_high = (-1.0,) * 3, (1.0,) * 3

    scale_inertia: bool = False
    """Apply the mass scale to the rotational inertia too."""
    observe_average_velocity: bool = True
    """Observe the average forward velocity as the last entry."""

    @property
    def obs_size(self) -> int:  # pyright: ignore[reportIncompatibleVariableOverride]
        """Width of an observation: 12, or the released code's 11."""
        return 12 if self.observe_average_velocity else 11

    def reward(self, obs: Obs, action: Action, next_obs: Obs) -> Reward:
        """Forward velocity over the step, a constant for being alive, and the effort."""
        velocity = next_obs[..., 11 if self.observe_average_velocity else 5]
        return velocity + 1.0 - 1e-3 * _effort(self.clip_action(action))

    def released_reward(self, obs: Obs, action: Action, next_obs: Obs) -> Reward:
        """As released: the clipped velocity before the step."""
        return obs[..., 5] + 1.0 - 1e-3 * _effort(self.unscale_action(action))

    def preprocess(self, obs: Obs) -> Float[Array, "*batch features"]:
        """Drop the average velocity."""
        return obs[..., :11]

    def target(self, obs: Obs, next_obs: Obs) -> Obs:
        """Differences, and the average velocity itself, if it is observed."""
        return (next_obs - obs).at[..., 11:].set(next_obs[..., 11:])

    def postprocess(self, obs: Obs, delta: Obs) -> Obs:
        """Undo `target`."""
        return (obs + delta).at[..., 11:].set(delta[..., 11:])


_QUATERNION = tuple(f"torso quaternion {part}" for part in "wxyz")
_VELOCITY = tuple(f"{axis} velocity (m/s)" for axis in "xyz")
_TURNING = tuple(f"{axis} angular velocity (rad/s)" for axis in "xyz")
_PLANAR = ("x velocity (m/s)", "z velocity (m/s)", "torso pitch rate (rad/s)")


def _joints(joints: str, *between: str) -> tuple[str, ...]:
    """Name angles of joints, then other entries, then the joints' rates."""
    names = joints.split(", ")
    angles = (f"{name} angle (rad)" for name in names)
    return (*angles, *between, *(f"{name} rate (rad/s)" for name in names))


HOPPER = EnvSpec(
    name="hopper",
    env_id="headway/Hopper-v0",
    make_task=HopperTask,
    sim_params=_mass_sets((0.5, 0.75, 1.0, 1.25, 1.5), (0.25, 0.375), (1.75, 2.0)),
    episode_length=500,
    default_sim_params={"mass_scale": 1.0, "damping_scale": 1.0},
    options={"scale_inertia": False, "observe_average_velocity": True},
    quick=QUICK_OF_FALLERS,
    description="hop forward on one leg with unknown masses",
    obs_names=(
        "height (m)", "torso pitch (rad)", *_joints("thigh, leg, foot", *_PLANAR),
        "average x velocity (m/s)",
    ),
)  # fmt: skip


class Hopper(Robot):
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

    spec, xml, frame_skip = HOPPER, "hopper.xml", 4
    camera = (3.1, -8.0, 0.75)
    start_noise = ("uniform", "uniform", 0.005)
    alive, effort = 1.0, 1e-3

    def observe(self, state: RobotState) -> np.ndarray:
        """Return positions but x, clipped velocities, and the average forward velocity."""
        velocity = state.velocity[..., None]
        parts = [state.qpos[..., 1:], np.clip(state.qvel, -10.0, 10.0), velocity]
        return np.concatenate(parts, axis=-1)[..., : self.task.obs_size]


class SlimHumanoidTask(Task):
    """Walk forward upright, with a humanoid observed only by its joints.

    reward = (0.25 / 0.015) ẋ - 0.1 Σ a² + 5 [1 ≤ z' ≤ 2], ẋ before and z' after the step.

    References:
        Supplement A.1; released `slim_humanoid_env.py`.
    """

    obs_size, action_size = 45, 17
    action_low, action_high = (-0.4,) * 17, (0.4,) * 17

    scale_inertia: bool = False
    """Apply the mass scale to the rotational inertia too."""

    def reward(self, obs: Obs, action: Action, next_obs: Obs) -> Reward:
        """Forward velocity before the step, effort, and a bonus for standing after it."""
        height = next_obs[..., 0]
        standing = (height >= 1.0) & (height <= 2.0)
        effort = _effort(self.clip_action(action))
        return 0.25 / 0.015 * obs[..., 22] - 0.1 * effort + 5.0 * standing

    def released_reward(self, obs: Obs, action: Action, next_obs: Obs) -> Reward:
        """As released: unscaled effort, and `obs[1]` (of the quaternion) taken for the height."""
        standing = (obs[..., 1] > 1.0) & (obs[..., 1] < 2.0)
        effort = _effort(self.unscale_action(action))
        return 0.25 / 0.015 * obs[..., 22] - 0.1 * effort + 5.0 * standing


SLIM_HUMANOID = EnvSpec(
    name="slim-humanoid",
    env_id="headway/SlimHumanoid-v0",
    make_task=SlimHumanoidTask,
    sim_params=_mass_sets((0.8, 0.9, 1.0, 1.15, 1.25), (0.6, 0.7), (1.5, 1.6)),
    episode_length=1000,
    default_sim_params={"mass_scale": 1.0, "damping_scale": 1.0},
    options={"scale_inertia": False},
    quick=QUICK_OF_FALLERS,
    description="walk upright as a humanoid with unknown masses",
    obs_names=(
        "height (m)", *_QUATERNION, *_joints(
            "abdomen z, abdomen y, abdomen x, right hip x, right hip z, right hip y, right knee,"
            " left hip x, left hip z, left hip y, left knee, right shoulder 1, right shoulder 2,"
            " right elbow, left shoulder 1, left shoulder 2, left elbow", *_VELOCITY, *_TURNING,
        ),
    ),
)  # fmt: skip


class SlimHumanoid(Robot):
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

    spec, xml, frame_skip = SLIM_HUMANOID, "humanoid.xml", 5
    camera = (3.6, -8.0, 0.9)
    start_noise = ("uniform", "uniform", 0.01)

    def observe(self, state: RobotState) -> np.ndarray:
        """Return positions but x and y, and velocities."""
        return np.concatenate([state.qpos[..., 2:], state.qvel], axis=-1)

    def reward(self, before: RobotState, action: np.ndarray, after: RobotState) -> np.ndarray:
        """Forward velocity before the step, effort, and 5 for standing after it."""
        height = after.qpos[..., 2]
        standing = (height >= 1.0) & (height <= 2.0)
        effort = np.square(action).sum(-1)
        return 0.25 / 0.015 * before.qvel[..., 0] - 0.1 * effort + 5.0 * standing


class HalfCheetahTask(Task):
    """Run forward.

    reward = (x' - x) / 0.05 - 0.1 Σ a², the first term being the next observation's `obs[0]`.

    `obs[0]` is predicted as it is, not as a difference, and is no feature; the pitch enters
    as sine and cosine.

    References:
        Supplement A.1; released `half_cheetah_env.py`.
    """

    obs_size, action_size = 18, 6
    action_low, action_high = (-1.0,) * 6, (1.0,) * 6

    scale_inertia: bool = False
    """Apply the mass scale to the rotational inertia too."""

    def reward(self, obs: Obs, action: Action, next_obs: Obs) -> Reward:
        """Forward velocity over the step, and the effort."""
        return next_obs[..., 0] - 0.1 * _effort(self.clip_action(action))

    def released_reward(self, obs: Obs, action: Action, next_obs: Obs) -> Reward:
        """As released: the velocity over the step before."""
        return obs[..., 0] - 0.1 * _effort(self.unscale_action(action))

    def preprocess(self, obs: Obs) -> Float[Array, "*batch features"]:
        """Return z, sin pitch, cos pitch, then the joint angles and all velocities."""
        height, pitch, others = obs[..., 1:2], obs[..., 2:3], obs[..., 3:]
        return jnp.concatenate([height, jnp.sin(pitch), jnp.cos(pitch), others], axis=-1)

    def target(self, obs: Obs, next_obs: Obs) -> Obs:
        """Differences, and the average velocity itself."""
        return (next_obs - obs).at[..., 0].set(next_obs[..., 0])

    def postprocess(self, obs: Obs, delta: Obs) -> Obs:
        """Undo `target`."""
        return (obs + delta).at[..., 0].set(delta[..., 0])


HALF_CHEETAH = EnvSpec(
    name="half-cheetah",
    env_id="headway/HalfCheetah-v0",
    make_task=HalfCheetahTask,
    sim_params=_mass_sets((0.25, 0.5, 1.5, 2.5), (0.1, 0.15), (2.75, 3.0)),
    episode_length=1000,
    default_sim_params={"mass_scale": 1.0, "damping_scale": 1.0},
    options={"scale_inertia": False},
    quick=QUICK,
    description="run forward on two legs with unknown masses",
    obs_names=(
        "average x velocity (m/s)", "height (m)", "torso pitch (rad)",
        *_joints(
            "back thigh, back shin, back foot, front thigh, front shin, front foot", *_PLANAR
        ),
    ),
)  # fmt: skip


class HalfCheetah(Robot):
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

    spec, xml, frame_skip = HALF_CHEETAH, "half_cheetah.xml", 5
    camera = (2.9, -12.0, 0.45)
    start_noise = ("normal", "normal", 0.001)
    effort = 0.1

    def observe(self, state: RobotState) -> np.ndarray:
        """Return the average forward velocity, positions but x, and velocities."""
        return np.concatenate([state.velocity[..., None], state.qpos[..., 1:], state.qvel], -1)


class CrippledAntTask(Task):
    """Walk forward on four legs, one of which does not obey.

    reward = (x' - x) / 0.05 + 0.05, x being the torso's position (`obs[38]`); effort is free.

    In single precision the difference of positions is exact only near the origin: the error
    of the reward is about 1e-6 per metre of |x|.

    References:
        Supplement A.1; released `ant_cripple_env.py`.
    """

    obs_size, action_size = 41, 8
    action_low, action_high = (-1.0,) * 8, (1.0,) * 8

    shrink_leg: bool = False
    """Make the crippled leg half as long and thick, too."""

    def reward(self, obs: Obs, action: Action, next_obs: Obs) -> Reward:
        """Forward velocity of the torso over the step, and a constant for being alive."""
        return (next_obs[..., 38] - obs[..., 38]) / 0.05 + 0.05


CRIPPLED_ANT = EnvSpec(
    name="crippled-ant",
    env_id="headway/CrippledAnt-v0",
    make_task=CrippledAntTask,
    sim_params=SimParamSets({"crippled_leg": (0.0, 1.0, 2.0)}, {"leg-3": {"crippled_leg": (3.0,)}}),
    episode_length=1000,
    default_sim_params={"crippled_leg": -1.0},
    options={"shrink_leg": False},
    quick=QUICK_OF_FALLERS,
    description="walk on four legs, one of which does not obey",
    obs_names=(
        "x (m)", "y (m)", "height (m)", *_QUATERNION,
        *_joints(
            ", ".join(f"hip {leg}, ankle {leg}" for leg in range(1, 5)), *_VELOCITY, *_TURNING
        ),
        *(f"torso rotation ({row}, {column})" for row in range(3) for column in range(3)),
        "torso x (m)", "torso y (m)", "torso z (m)",
    ),
)  # fmt: skip


class CrippledAnt(Robot):
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

    spec, xml, frame_skip = CRIPPLED_ANT, "ant.xml", 5
    camera = (3.4, -40.0, 0.3)
    start_noise = ("uniform", "normal", 0.1)
    alive = 0.05
    choices: ClassVar[Mapping[str, tuple[float, ...]]] = {"crippled_leg": (-1, 0, 1, 2, 3)}
    leg_geoms = (
        ("left_leg_geom", "left_ankle_geom"),
        ("right_leg_geom", "right_ankle_geom"),
        ("back_leg_geom", "third_ankle_geom"),
        ("rightback_leg_geom", "fourth_ankle_geom"),
    )
    """Upper and lower part of each leg."""
    # Leg i obeys the i-th of these pairs of actuators; the last row serves leg -1: all obey.
    obeying = np.vstack([np.repeat(np.arange(4) != pair, 2) for pair in (1, 2, 3, 0, -1)])

    def set_physics(self, model: Any, sim_params: Mapping[str, float]) -> None:
        """Colour the crippled leg and, if asked for, halve its capsules."""
        for name in ("geom_size", "geom_pos", "geom_rgba"):
            getattr(model, name)[:] = getattr(self.nominal, name)
        leg = int(sim_params["crippled_leg"])
        if leg < 0:
            return
        upper, lower = (model.geom(name).id for name in self.leg_geoms[leg])
        model.geom_rgba[[upper, lower]] = GREY
        if self.task.shrink_leg:
            model.geom_size[[upper, lower]] *= 0.5
            model.geom_pos[lower] = model.geom_pos[upper]

    def control(self, action: np.ndarray, sim_params: Mapping[str, Any]) -> np.ndarray:
        """Silence the two motors of the crippled leg."""
        return action * self.obeying[np.asarray(sim_params["crippled_leg"], int)]

    def observe(self, state: RobotState) -> np.ndarray:
        """Return positions, velocities, the torso's rotation matrix and its position."""
        from scipy.spatial.transform import Rotation  # a quarter of a second, for this robot only

        quaternions = state.qpos[..., 3:7].reshape(-1, 4)
        rotation = Rotation.from_quat(quaternions, scalar_first=True).as_matrix()
        rotation = rotation.reshape(*state.qpos.shape[:-1], 9)
        return np.concatenate([state.qpos, state.qvel, rotation, state.qpos[..., :3]], axis=-1)


WORLDS = (Hopper, SlimHumanoid, HalfCheetah, CrippledAnt)


@functools.cache
def load_model(xml: str) -> Any:
    """Compile one of Gymnasium's MuJoCo models.

    The half cheetah asks the compiler for a total mass, which MuJoCo deprecates with a
    warning on the terminal; the same is done here after compiling.
    """
    import mujoco

    from headway.worlds import rendering

    path = resources.files("gymnasium") / "envs" / "mujoco" / "assets" / xml
    spec = mujoco.MjSpec.from_file(str(path))
    total_mass = spec.compiler.settotalmass
    spec.compiler.settotalmass = -1
    rendering.restyle(spec)
    model = spec.compile()
    rendering.paint(model)
    if total_mass > 0:
        mujoco.mj_setTotalmass(model, total_mass)
        mujoco.mj_setConst(model, mujoco.MjData(model))
    return model
