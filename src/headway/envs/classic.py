"""CartPoleSwingUp and Pendulum: equations of motion, for NumPy and for JAX.

The environments step them in NumPy's float64; a planner that knows the true dynamics compiles
them (`xp=jax.numpy`).
"""

import abc
from collections.abc import Mapping
from typing import Any, ClassVar, NamedTuple

import numpy as np
from gymnasium.spaces import Box

from headway.envs import drawing
from headway.envs.world import World, WorldEnv, check_state
from headway.sim_params import SimParamSets
from headway.tasks.classic import TRACK_LIMIT, CartPoleSwingUpTask, PendulumTask


class Step(NamedTuple):
    """Result of a step, of one or of many environments."""

    state: np.ndarray
    reward: np.ndarray
    terminated: np.ndarray


class ClassicWorld(World):
    """A world whose state is a few numbers and whose step is a formula."""

    obs_dtype = np.float32
    state_size: ClassVar[int]
    time_step: ClassVar[float]

    @abc.abstractmethod
    def initial_state(self, rng: np.random.Generator) -> np.ndarray:
        """Draw the state that an episode starts in."""

    @abc.abstractmethod
    def advance(self, state: np.ndarray, action: np.ndarray, sim_params: Mapping[str, Any]) -> Step:
        """Make one step from `state` [..., state] with `action` [..., action]."""

    @abc.abstractmethod
    def next_state(
        self, state: Any, action: Any, sim_params: Mapping[str, Any], xp: Any = np
    ) -> Any:
        """The state [..., state] after a step, by `numpy` or by `jax.numpy`."""

    @abc.abstractmethod
    def observe(self, state: Any, xp: Any = np) -> Any:
        """Return the observation [..., obs] of a state, by `numpy` or by `jax.numpy`."""

    @abc.abstractmethod
    def draw_frame(
        self, state: np.ndarray, action: np.ndarray, sim_params: Mapping[str, float]
    ) -> np.ndarray:
        """Draw a state and the action that led to it."""


class CartPoleWorld(ClassicWorld):
    """Equations of gym-cartpole-swingup; θ = 0 is upright, explicit Euler steps of 0.01 s."""

    name = "cartpole-swingup"
    state_size = 4
    gravity, force, time_step, friction = 9.82, 10.0, 0.01, 0.1
    cart_mass, pole_mass, pole_length = 0.5, 0.5, 0.6

    def __init__(self, sim_params: SimParamSets | None = None, *, terminate_off_track=False):
        super().__init__(CartPoleSwingUpTask(terminate_off_track), sim_params)
        self.terminate_off_track = terminate_off_track

    @property
    def observation_space(self) -> Box:
        """The pole's direction is bounded."""
        high = np.array([np.inf, np.inf, 1, 1, np.inf], np.float32)
        return Box(-high, high, dtype=np.float32)

    def initial_state(self, rng: np.random.Generator) -> np.ndarray:
        """Nearly at rest, hanging down: mean (0, 0, π, 0), standard deviation 0.2."""
        return rng.normal([0.0, 0.0, np.pi, 0.0], 0.2)

    def advance(self, state: np.ndarray, action: np.ndarray, sim_params: Mapping[str, Any]) -> Step:
        """Positions advance with the old velocities."""
        after = self.next_state(state, action, sim_params)
        obs = self.observe(after)
        reward = 0.5 * (1.0 + obs[..., 2].astype(np.float64))
        off_track = np.abs(obs[..., 0]) > np.float32(TRACK_LIMIT)
        return Step(after, reward, off_track & self.terminate_off_track)

    def next_state(
        self, state: Any, action: Any, sim_params: Mapping[str, Any], xp: Any = np
    ) -> Any:
        """See `ClassicWorld.next_state`."""
        scale = sim_params["mass_scale"]
        m, total = self.pole_mass * scale, (self.pole_mass + self.cart_mass) * scale
        g, length = self.gravity, self.pole_length
        _, v, angle, spin = xp.moveaxis(state, -1, 0)
        sin, cos = xp.sin(angle), xp.cos(angle)
        push = self.force * action[..., 0] - self.friction * v
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

    def draw_frame(
        self, state: np.ndarray, action: np.ndarray, sim_params: Mapping[str, float]
    ) -> np.ndarray:
        """Draw cart, pole and the pushing force."""
        return drawing.cart_pole(
            state[0], state[2], self.pole_length, float(action[0]), sim_params["mass_scale"]
        )


class PendulumWorld(ClassicWorld):
    """Equations of OpenAI Gym 0.16's Pendulum; θ = 0 is upright, steps of 0.05 s."""

    name = "pendulum"
    state_size = 2
    gravity, time_step, max_speed = 10.0, 0.05, 8.0

    def __init__(self, sim_params: SimParamSets | None = None):
        super().__init__(PendulumTask(), sim_params)

    @property
    def observation_space(self) -> Box:
        """Direction and clipped speed."""
        high = np.array([1.0, 1.0, self.max_speed], np.float32)
        return Box(-high, high, dtype=np.float32)

    def initial_state(self, rng: np.random.Generator) -> np.ndarray:
        """Any angle, and a speed within ±1 rad/s."""
        return rng.uniform([-np.pi, -1.0], [np.pi, 1.0])

    def advance(self, state: np.ndarray, action: np.ndarray, sim_params: Mapping[str, Any]) -> Step:
        """The angle advances with the new speed before that is clipped."""
        angle, spin = np.moveaxis(state, -1, 0)
        torque = action[..., 0]
        wrapped = np.mod(angle + np.pi, 2 * np.pi) - np.pi
        cost = np.square(wrapped) + 0.1 * np.square(spin) + 0.001 * np.square(torque)
        after = self.next_state(state, action, sim_params)
        return Step(after, -cost, np.zeros(cost.shape, bool))

    def next_state(
        self, state: Any, action: Any, sim_params: Mapping[str, Any], xp: Any = np
    ) -> Any:
        """See `ClassicWorld.next_state`."""
        angle, spin = xp.moveaxis(state, -1, 0)
        mass, length = sim_params["mass"], sim_params["length"]
        inertia = mass * xp.square(length)
        spin_dot = 1.5 * self.gravity / length * xp.sin(angle) + 3.0 * action[..., 0] / inertia
        new_spin = spin + spin_dot * self.time_step
        new_angle = angle + new_spin * self.time_step
        new_spin = xp.clip(new_spin, -self.max_speed, self.max_speed)
        return xp.stack([new_angle, new_spin], -1)

    def observe(self, state: Any, xp: Any = np) -> Any:
        """Return cos θ, sin θ, θ̇."""
        angle, spin = xp.moveaxis(state, -1, 0)
        return xp.stack([xp.cos(angle), xp.sin(angle), spin], axis=-1).astype(np.float32)

    def draw_frame(
        self, state: np.ndarray, action: np.ndarray, sim_params: Mapping[str, float]
    ) -> np.ndarray:
        """Draw the rod at its true relative length, and the torque."""
        return drawing.pendulum(state[0], sim_params["length"], float(action[0]) / 2.0)


class ClassicEnv(WorldEnv):
    """A batch of one of a classic world."""

    _world: ClassicWorld

    def __init__(self, world: ClassicWorld, render_mode: str | None):
        super().__init__(world, render_mode)
        self.metadata = self.metadata | {"render_fps": round(1 / world.time_step)}
        self._state = np.zeros((1, world.state_size))
        self._action = np.zeros(1)

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        """Make one step; actions beyond their bounds are clipped.

        Raises:
            ConfigError: The action has the wrong shape or is not finite.
        """
        self._action = self._world.clip(action, (1,))
        self._begin_step()
        step = self._world.advance(self._state, self._action[None], self._sim_params)
        self._state = step.state
        reward, terminated = float(step.reward[0]), bool(step.terminated[0])
        return self.observation(), reward, terminated, False, self._info()

    def observation(self) -> np.ndarray:
        """Return the observation of the present state."""
        return self._world.observe(self._state)[0]

    def get_state(self) -> np.ndarray:
        """Return positions and velocities."""
        return self._state[0].copy()

    def set_state(self, state: np.ndarray) -> None:
        """Go to a state that `get_state` returned.

        Raises:
            ConfigError: The state has the wrong size or is not finite.
        """
        self._state = check_state(self._world.name, state, self._world.state_size)[None].copy()

    def render(self) -> np.ndarray | None:  # pyright: ignore[reportIncompatibleMethodOverride]
        """Draw the present state, if `render_mode` is `"rgb_array"`."""
        if self.render_mode is None:
            return None
        return self._world.draw_frame(self._state[0], self._action, self._sim_params)

    def _reset_state(self) -> None:
        self._state = self._world.initial_state(self.np_random)[None]
        self._action = np.zeros(1)


class CartPoleSwingUpEnv(ClassicEnv):
    """Swing a pole up by pushing the cart it hangs from, and keep it up.

    | What | Value |
    | --- | --- |
    | observation | 0 x (m), 1 ẋ, 2 cos θ, 3 sin θ, 4 θ̇; θ = 0 upright; float32 |
    | action | force on the cart in units of 10 N, [-1, 1] |
    | reward | (1 + cos θ') / 2 after the step, from the observed cos θ' |
    | sim_params | `mass_scale`: cart and pole weigh 0.5 kg times this |
    | reset | Normal((0, 0, π, 0), 0.2) |
    | end | after 500 steps; option `terminate_off_track`: when abs(x') > 2.4 m |
    | step | 0.01 s, explicit Euler; g 9.82, pole 0.6 m, cart friction 0.1 |

    Source: supplement A.1 and gym-cartpole-swingup; masses are scales, drawn jointly.
    """

    def __init__(
        self,
        *,
        terminate_off_track: bool = False,
        sim_params: SimParamSets | None = None,
        render_mode: str | None = None,
    ):
        world = CartPoleWorld(sim_params, terminate_off_track=terminate_off_track)
        super().__init__(world, render_mode)


class PendulumEnv(ClassicEnv):
    """Swing a pendulum up with a torque too weak to lift it directly, and keep it up.

    | What | Value |
    | --- | --- |
    | observation | 0 cos θ, 1 sin θ, 2 θ̇ (rad/s); θ = 0 upright; float32 |
    | action | torque u (N m), [-2, 2] |
    | reward | -(θ² + 0.1 θ̇² + 0.001 u²) before the step, θ wrapped to ±π |
    | sim_params | `length` (m) and `mass` (kg) of the rod |
    | reset | θ uniform in ±π, θ̇ uniform in ±1 |
    | end | after 200 steps |
    | step | 0.05 s: θ̇ += (1.5 g/l sin θ + 3 u/(m l²)) dt; θ += θ̇ dt; then θ̇ clipped to ±8; g 10 |

    Source: supplement A.1 and OpenAI Gym 0.16 (which integrates before it clips).
    """

    def __init__(self, *, sim_params: SimParamSets | None = None, render_mode: str | None = None):
        super().__init__(PendulumWorld(sim_params), render_mode)
