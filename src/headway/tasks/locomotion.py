"""Tasks of the four MuJoCo robots: all are paid for moving forward."""

from typing import ClassVar

import jax.numpy as jnp
from jaxtyping import Array, Float

from headway.tasks.base import Task


def _effort(action: Float[Array, "*batch action"]) -> Float[Array, "*batch"]:
    return jnp.square(action).sum(-1)


def _target_but(
    index: int, obs: Float[Array, "*batch obs"], next_obs: Float[Array, "*batch obs"]
) -> Float[Array, "*batch obs"]:
    """Differences, except one entry that is predicted itself."""
    return (next_obs - obs).at[..., index].set(next_obs[..., index])


def _postprocess_but(
    index: int, obs: Float[Array, "*batch obs"], delta: Float[Array, "*batch obs"]
) -> Float[Array, "*batch obs"]:
    """Undo `_target_but`."""
    return (obs + delta).at[..., index].set(delta[..., index])


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

    action_size: ClassVar[int] = 3
    action_low: ClassVar[tuple[float, ...]] = (-1.0,) * 3
    action_high: ClassVar[tuple[float, ...]] = (1.0,) * 3

    scale_inertia: bool = False
    """Whether the mass scale applies to the rotational inertia too."""
    observe_average_velocity: bool = True
    """Whether the observation has the average forward velocity as its last entry."""

    @property
    def obs_size(self) -> int:  # pyright: ignore[reportIncompatibleVariableOverride]
        """Width of an observation: 12, or the released code's 11."""
        return 12 if self.observe_average_velocity else 11

    def reward(
        self,
        obs: Float[Array, "*batch obs"],
        action: Float[Array, "*batch action"],
        next_obs: Float[Array, "*batch obs"],
    ) -> Float[Array, "*batch"]:
        """Forward velocity over the step, a constant for being alive, and the effort."""
        del obs
        velocity = next_obs[..., 11 if self.observe_average_velocity else 5]
        return velocity + 1.0 - 1e-3 * _effort(self.clip_action(action))

    def released_reward(
        self,
        obs: Float[Array, "*batch obs"],
        action: Float[Array, "*batch action"],
        next_obs: Float[Array, "*batch obs"],
    ) -> Float[Array, "*batch"]:
        """As released: the clipped velocity before the step."""
        del next_obs
        return obs[..., 5] + 1.0 - 1e-3 * _effort(self.unscale_action(action))

    def preprocess(self, obs: Float[Array, "*batch obs"]) -> Float[Array, "*batch features"]:
        """Drop the average velocity."""
        return obs[..., :11]

    def target(
        self, obs: Float[Array, "*batch obs"], next_obs: Float[Array, "*batch obs"]
    ) -> Float[Array, "*batch obs"]:
        """Differences, and the average velocity itself."""
        if not self.observe_average_velocity:
            return next_obs - obs
        return _target_but(11, obs, next_obs)

    def postprocess(
        self, obs: Float[Array, "*batch obs"], delta: Float[Array, "*batch obs"]
    ) -> Float[Array, "*batch obs"]:
        """Undo `target`."""
        if not self.observe_average_velocity:
            return obs + delta
        return _postprocess_but(11, obs, delta)


class SlimHumanoidTask(Task):
    """Walk forward upright, with a humanoid observed only by its joints.

    reward = (0.25 / 0.015) ẋ - 0.1 Σ a² + 5 [1 ≤ z' ≤ 2], ẋ before and z' after the step.

    References:
        Supplement A.1; released `slim_humanoid_env.py`.
    """

    obs_size: ClassVar[int] = 45
    action_size: ClassVar[int] = 17
    action_low: ClassVar[tuple[float, ...]] = (-0.4,) * 17
    action_high: ClassVar[tuple[float, ...]] = (0.4,) * 17

    scale_inertia: bool = False
    """Whether the mass scale applies to the rotational inertia too."""

    def reward(
        self,
        obs: Float[Array, "*batch obs"],
        action: Float[Array, "*batch action"],
        next_obs: Float[Array, "*batch obs"],
    ) -> Float[Array, "*batch"]:
        """Forward velocity before the step, effort, and a bonus for standing after it."""
        height = next_obs[..., 0]
        standing = (height >= 1.0) & (height <= 2.0)
        effort = _effort(self.clip_action(action))
        return 0.25 / 0.015 * obs[..., 22] - 0.1 * effort + 5.0 * standing

    def released_reward(
        self,
        obs: Float[Array, "*batch obs"],
        action: Float[Array, "*batch action"],
        next_obs: Float[Array, "*batch obs"],
    ) -> Float[Array, "*batch"]:
        """As released: unscaled effort, and `obs[1]` (of the quaternion) taken for the height."""
        del next_obs
        standing = (obs[..., 1] > 1.0) & (obs[..., 1] < 2.0)
        effort = _effort(self.unscale_action(action))
        return 0.25 / 0.015 * obs[..., 22] - 0.1 * effort + 5.0 * standing


class HalfCheetahTask(Task):
    """Run forward.

    reward = (x' - x) / 0.05 - 0.1 Σ a², the first term being the next observation's `obs[0]`.

    `obs[0]` is predicted as it is, not as a difference, and is no feature; the pitch enters
    as sine and cosine.

    References:
        Supplement A.1; released `half_cheetah_env.py`.
    """

    obs_size: ClassVar[int] = 18
    action_size: ClassVar[int] = 6
    action_low: ClassVar[tuple[float, ...]] = (-1.0,) * 6
    action_high: ClassVar[tuple[float, ...]] = (1.0,) * 6

    scale_inertia: bool = False
    """Whether the mass scale applies to the rotational inertia too."""

    def reward(
        self,
        obs: Float[Array, "*batch obs"],
        action: Float[Array, "*batch action"],
        next_obs: Float[Array, "*batch obs"],
    ) -> Float[Array, "*batch"]:
        """Forward velocity over the step, and the effort."""
        del obs
        return next_obs[..., 0] - 0.1 * _effort(self.clip_action(action))

    def released_reward(
        self,
        obs: Float[Array, "*batch obs"],
        action: Float[Array, "*batch action"],
        next_obs: Float[Array, "*batch obs"],
    ) -> Float[Array, "*batch"]:
        """As released: the velocity over the step before."""
        del next_obs
        return obs[..., 0] - 0.1 * _effort(self.unscale_action(action))

    def preprocess(self, obs: Float[Array, "*batch obs"]) -> Float[Array, "*batch features"]:
        """Return z, sin pitch, cos pitch, then the joint angles and all velocities."""
        pitch = obs[..., 2:3]
        return jnp.concatenate(
            [obs[..., 1:2], jnp.sin(pitch), jnp.cos(pitch), obs[..., 3:]], axis=-1
        )

    def target(
        self, obs: Float[Array, "*batch obs"], next_obs: Float[Array, "*batch obs"]
    ) -> Float[Array, "*batch obs"]:
        """Differences, and the average velocity itself."""
        return _target_but(0, obs, next_obs)

    def postprocess(
        self, obs: Float[Array, "*batch obs"], delta: Float[Array, "*batch obs"]
    ) -> Float[Array, "*batch obs"]:
        """Undo `target`."""
        return _postprocess_but(0, obs, delta)


class CrippledAntTask(Task):
    """Walk forward on four legs, one of which does not obey.

    reward = (x' - x) / 0.05 + 0.05, x being the torso's position (`obs[38]`); effort is free.

    In single precision the difference of positions is exact only near the origin: the error
    of the reward is about 1e-6 per metre of |x|.

    References:
        Supplement A.1; released `ant_cripple_env.py`.
    """

    obs_size: ClassVar[int] = 41
    action_size: ClassVar[int] = 8
    action_low: ClassVar[tuple[float, ...]] = (-1.0,) * 8
    action_high: ClassVar[tuple[float, ...]] = (1.0,) * 8

    shrink_leg: bool = False
    """Whether the crippled leg is also half as long and thick."""

    def reward(
        self,
        obs: Float[Array, "*batch obs"],
        action: Float[Array, "*batch action"],
        next_obs: Float[Array, "*batch obs"],
    ) -> Float[Array, "*batch"]:
        """Forward velocity of the torso over the step, and a constant for being alive."""
        del action
        return (next_obs[..., 38] - obs[..., 38]) / 0.05 + 0.05
