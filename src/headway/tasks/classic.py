"""Tasks of the two classic control environments."""

from typing import ClassVar

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from headway.tasks.base import Task

TRACK_LIMIT = 2.4
"""Largest distance of the cart from the middle of the track (m)."""


class CartPoleSwingUpTask(Task):
    """Swing a pole up by pushing the cart it hangs from, and keep it up.

    reward = (1 + cos θ') / 2, of the next observation: 0 hanging, 1 upright.

    The released code has no such task; its `released_reward` is therefore the same.

    References:
        Supplement A.1; reward and equations of gym-cartpole-swingup.
    """

    obs_size: ClassVar[int] = 5
    action_size: ClassVar[int] = 1
    action_low: ClassVar[tuple[float, ...]] = (-1.0,)
    action_high: ClassVar[tuple[float, ...]] = (1.0,)

    terminate_off_track: bool = False
    """Whether the episode ends when the cart is more than 2.4 m from the middle."""

    def reward(
        self,
        obs: Float[Array, "*batch obs"],
        action: Float[Array, "*batch action"],
        next_obs: Float[Array, "*batch obs"],
    ) -> Float[Array, "*batch"]:
        """Height of the pole's tip after the step, scaled to [0, 1]."""
        del obs, action
        return 0.5 * (1.0 + next_obs[..., 2])

    def terminated(
        self,
        obs: Float[Array, "*batch obs"],
        action: Float[Array, "*batch action"],
        next_obs: Float[Array, "*batch obs"],
    ) -> Bool[Array, "*batch"]:
        """Whether the cart left the track, if that ends an episode."""
        del obs, action
        off_track = jnp.abs(next_obs[..., 0]) > TRACK_LIMIT
        return off_track & self.terminate_off_track


class PendulumTask(Task):
    """Swing a pendulum up with a torque too weak to lift it directly, and keep it up.

    reward = -(θ² + 0.1 θ̇² + 0.001 u²), before the step; θ in (-π, π], 0 upright; u in N m.

    References:
        Supplement A.1; reward of OpenAI Gym's Pendulum.
    """

    obs_size: ClassVar[int] = 3
    action_size: ClassVar[int] = 1
    action_low: ClassVar[tuple[float, ...]] = (-2.0,)
    action_high: ClassVar[tuple[float, ...]] = (2.0,)

    def reward(
        self,
        obs: Float[Array, "*batch obs"],
        action: Float[Array, "*batch action"],
        next_obs: Float[Array, "*batch obs"],
    ) -> Float[Array, "*batch"]:
        """Minus the cost of angle, speed and torque before the step."""
        del next_obs
        return -_swing_cost(obs) - 0.001 * jnp.square(self.clip_action(action)[..., 0])

    def released_reward(
        self,
        obs: Float[Array, "*batch obs"],
        action: Float[Array, "*batch action"],
        next_obs: Float[Array, "*batch obs"],
    ) -> Float[Array, "*batch"]:
        """Cost of CaDM's released pendulum: the torque counts in units of its limit."""
        del next_obs
        return -_swing_cost(obs) - 0.001 * jnp.square(self.unscale_action(action)[..., 0])


def _swing_cost(obs: Float[Array, "*batch 3"]) -> Float[Array, "*batch"]:
    angle = jnp.arctan2(obs[..., 1], obs[..., 0])
    return jnp.square(angle) + 0.1 * jnp.square(obs[..., 2])
