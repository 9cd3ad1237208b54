"""CartPoleSwingUp and Pendulum: Task, equations of motion and physics.

Environments step the equations in NumPy's float64; a planner that knows the true dynamics
compiles them (`xp=jax.numpy`).
"""

from collections.abc import Mapping
from typing import Any, ClassVar

import jax.numpy as jnp
import numpy as np

from headway.sim_params import SimParamSets
from headway.task import Action, Ends, EnvSpec, Obs, Reward, Task
from headway.worlds.base import World

Physics = Mapping[str, Any]
"""Simulator parameters, each a number or an array with the axes of the states."""
TRACK_LIMIT = 2.4
"""Largest distance of the cart from the middle of the track (m)."""


class ClassicWorld(World):
    """A world whose state is a few numbers and whose step is a formula.

    Subclasses write `initial_state(rng)`, `next_state(state, action, sim_params)`,
    `observe(state)` and `reward(state, action, next_state)`; `next_state` and `observe` also
    with `xp=jax.numpy`.
    """

    obs_dtype = np.float32
    signed = ("gain",)
    state_size: ClassVar[int]

    def terminated(self, next_state: np.ndarray) -> np.ndarray:
        """Return where a step ended the episode."""
        return np.zeros(next_state.shape[:-1], bool)


class CartPoleSwingUpTask(Task):
    """Swing a pole up by pushing the cart it hangs from, and keep it up.

    reward = (1 + cos θ') / 2, of the next observation: 0 hanging, 1 upright.

    The released code has no such task; its `released_reward` is therefore the same.

    References:
        Supplement A.1; reward and equations of gym-cartpole-swingup.
    """

    obs_size, action_size = 5, 1
    action_low, action_high = (-1.0,), (1.0,)

    terminate_off_track: bool = False
    """End the episode when the cart is more than 2.4 m from the middle."""

    def reward(self, obs: Obs, action: Action, next_obs: Obs) -> Reward:
        """Height of the pole's tip after the step, scaled to [0, 1]."""
        return 0.5 * (1.0 + next_obs[..., 2])

    def terminated(self, obs: Obs, action: Action, next_obs: Obs) -> Ends:
        """Mark where the cart left the track, if that ends an episode."""
        return (jnp.abs(next_obs[..., 0]) > TRACK_LIMIT) & self.terminate_off_track


CARTPOLE_SWINGUP = EnvSpec(
    name="cartpole-swingup",
    env_id="headway/CartPoleSwingUp-v0",
    make_task=CartPoleSwingUpTask,
    sim_params=SimParamSets(
        {"mass_scale": (0.25, 0.5, 1.5, 2.5)},
        {"low": {"mass_scale": (0.1, 0.15)}, "high": {"mass_scale": (2.75, 3.0)}},
    ),
    episode_length=500,
    default_sim_params={"mass_scale": 1.0, "gain": 1.0},
    options={"terminate_off_track": False},
    description="swing a pole of unknown mass up by its cart, also of unknown mass",
    obs_names=(
        "cart position (m)", "cart velocity (m/s)", "cos θ", "sin θ", "pole rate (rad/s)",
    ),
)  # fmt: skip


class CartPoleSwingUp(ClassicWorld):
    """Equations of gym-cartpole-swingup.

    | What | Value |
    | --- | --- |
    | observation | 0 x (m), 1 ẋ, 2 cos θ, 3 sin θ, 4 θ̇; θ = 0 upright; float32 |
    | action | force on the cart in units of 10 N, [-1, 1] |
    | reward | (1 + cos θ') / 2 after the step, from the observed cos θ' |
    | sim_params | `mass_scale`: cart and pole weigh 0.5 kg times this |
    | | `gain`: the force is the action's times this; -1 pushes the other way, 0 not at all |
    | reset | Normal((0, 0, π, 0), 0.2) |
    | end | after 500 steps; option `terminate_off_track`: when abs(x') > 2.4 m |
    | step | 0.01 s, explicit Euler; g 9.82, pole 0.6 m, cart friction 0.1 |

    Source: supplement A.1 and gym-cartpole-swingup; masses are scales, drawn jointly.
    """

    spec = CARTPOLE_SWINGUP
    state_size = 4
    time_step = 0.01
    gravity, force, friction = 9.82, 10.0, 0.1
    cart_mass, pole_mass, pole_length = 0.5, 0.5, 0.6
    obs_bounds = (np.inf, np.inf, 1.0, 1.0, np.inf)

    def initial_state(self, rng: np.random.Generator) -> np.ndarray:
        """Nearly at rest, hanging down."""
        return rng.normal([0.0, 0.0, np.pi, 0.0], 0.2)

    def next_state(self, state: Any, action: Any, sim_params: Physics, xp: Any = np) -> Any:
        """Advance positions with the old velocities."""
        scale = sim_params["mass_scale"]
        m, total = self.pole_mass * scale, (self.pole_mass + self.cart_mass) * scale
        g, length = self.gravity, self.pole_length
        _, v, angle, spin = xp.moveaxis(state, -1, 0)
        sin, cos = xp.sin(angle), xp.cos(angle)
        push = self.force * sim_params["gain"] * action[..., 0] - self.friction * v
        swing = m * length * xp.square(spin) * sin
        v_dot = (-2 * swing + 3 * m * g * sin * cos + 4 * push) / (4 * total - 3 * m * cos * cos)
        spin_dot = (-3 * swing * cos + 6 * total * g * sin + 6 * push * cos) / (
            4 * length * total - 3 * m * length * cos * cos
        )
        return state + self.time_step * xp.stack([v, v_dot, spin, spin_dot], axis=-1)

    def observe(self, state: Any, xp: Any = np) -> Any:
        """Return x, ẋ, cos θ, sin θ, θ̇."""
        x, v, angle, spin = xp.moveaxis(state, -1, 0)
        return xp.stack([x, v, xp.cos(angle), xp.sin(angle), spin], -1).astype(np.float32)

    def reward(self, state: np.ndarray, action: np.ndarray, next_state: np.ndarray) -> np.ndarray:
        """Height of the pole's tip after the step, as observed."""
        return 0.5 * (1.0 + self.observe(next_state)[..., 2].astype(np.float64))

    def terminated(self, next_state: np.ndarray) -> np.ndarray:
        """Compare the position as observed, as the Task does."""
        off_track = np.abs(self.observe(next_state)[..., 0]) > np.float32(TRACK_LIMIT)
        return off_track & self.task.terminate_off_track


class PendulumTask(Task):
    """Swing a pendulum up with a torque too weak to lift it directly, and keep it up.

    reward = -(θ² + 0.1 θ̇² + 0.001 u²), before the step; θ in (-π, π], 0 upright; u in N m.

    References:
        Supplement A.1; reward of OpenAI Gym's Pendulum.
    """

    obs_size, action_size = 3, 1
    action_low, action_high = (-2.0,), (2.0,)

    def reward(self, obs: Obs, action: Action, next_obs: Obs) -> Reward:
        """Minus the cost of angle, speed and torque before the step."""
        return -_swing_cost(obs) - 0.001 * jnp.square(self.clip_action(action)[..., 0])

    def released_reward(self, obs: Obs, action: Action, next_obs: Obs) -> Reward:
        """Cost of CaDM's released pendulum: the torque counts in units of its limit."""
        return -_swing_cost(obs) - 0.001 * jnp.square(self.unscale_action(action)[..., 0])


def _swing_cost(obs: Obs) -> Reward:
    angle = jnp.arctan2(obs[..., 1], obs[..., 0])
    return jnp.square(angle) + 0.1 * jnp.square(obs[..., 2])


PENDULUM = EnvSpec(
    name="pendulum",
    env_id="headway/Pendulum-v0",
    make_task=PendulumTask,
    sim_params=SimParamSets(
        {"length": (0.5, 0.75, 1.0, 1.25), "mass": (1.0,)},
        {
            "low": {"length": (0.25, 0.375), "mass": (1.0,)},
            "high": {"length": (1.5, 1.75), "mass": (1.0,)},
        },
    ),
    episode_length=200,
    default_sim_params={"length": 1.0, "mass": 1.0, "gain": 1.0},
    description="swing a pendulum of unknown length up",
    epochs=5,
    obs_names=("cos θ", "sin θ", "angular velocity (rad/s)"),
)


class Pendulum(ClassicWorld):
    """Equations of OpenAI Gym 0.16's Pendulum.

    | What | Value |
    | --- | --- |
    | observation | 0 cos θ, 1 sin θ, 2 θ̇ (rad/s); θ = 0 upright; float32 |
    | action | torque u (N m), [-2, 2] |
    | reward | -(θ² + 0.1 θ̇² + 0.001 u²) before the step, θ wrapped to ±π |
    | sim_params | `length` (m) and `mass` (kg) of the rod |
    | | `gain`: the torque is u times this; -1 turns the other way, 0 not at all; u is paid for |
    | reset | θ uniform in ±π, θ̇ uniform in ±1 |
    | end | after 200 steps |
    | step | 0.05 s: θ̇ += (1.5 g/l sin θ + 3 gain u/(m l²)) dt; θ += θ̇ dt; θ̇ clipped to ±8; g 10 |

    Source: supplement A.1 and OpenAI Gym 0.16 (which integrates before it clips).
    """

    spec = PENDULUM
    state_size = 2
    time_step = 0.05
    gravity, max_speed = 10.0, 8.0
    obs_bounds = (1.0, 1.0, max_speed)

    def initial_state(self, rng: np.random.Generator) -> np.ndarray:
        """Any angle, and a speed within ±1 rad/s."""
        return rng.uniform([-np.pi, -1.0], [np.pi, 1.0])

    def next_state(self, state: Any, action: Any, sim_params: Physics, xp: Any = np) -> Any:
        """Advance the angle with the new speed before that is clipped."""
        angle, spin = xp.moveaxis(state, -1, 0)
        mass, length = sim_params["mass"], sim_params["length"]
        inertia = mass * xp.square(length)
        torque = sim_params["gain"] * action[..., 0]
        spin_dot = 1.5 * self.gravity / length * xp.sin(angle) + 3.0 * torque / inertia
        new_spin = spin + spin_dot * self.time_step
        new_angle = angle + new_spin * self.time_step
        new_spin = xp.clip(new_spin, -self.max_speed, self.max_speed)
        return xp.stack([new_angle, new_spin], -1)

    def observe(self, state: Any, xp: Any = np) -> Any:
        """Return cos θ, sin θ, θ̇."""
        angle, spin = xp.moveaxis(state, -1, 0)
        return xp.stack([xp.cos(angle), xp.sin(angle), spin], axis=-1).astype(np.float32)

    def reward(self, state: np.ndarray, action: np.ndarray, next_state: np.ndarray) -> np.ndarray:
        """Minus the cost of angle, speed and commanded torque before the step."""
        angle, spin = np.moveaxis(state, -1, 0)
        wrapped = np.mod(angle + np.pi, 2 * np.pi) - np.pi
        torque = action[..., 0]
        return -(np.square(wrapped) + 0.1 * np.square(spin) + 0.001 * np.square(torque))


WORLDS = (Pendulum, CartPoleSwingUp)
