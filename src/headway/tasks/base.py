"""What a model and a planner must know of an environment, written once, in JAX."""

import abc
from typing import ClassVar

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float


class Task(eqx.Module):
    """The reward, the end of an episode, and how observations enter and leave a model.

    Every method is pure JAX and written for one transition with any number of leading
    axes. `action` is always in the environment's own units; the model and the planner work
    with actions scaled to [-1, 1] and convert with `scale_action`.

    Subclasses state the sizes as class variables (a property where an option changes one)
    and override what differs from the plain case: preprocess = identity, target =
    next_obs - obs, no termination. Options of an environment are fields of its Task.

    Example:
        A point pushed along a line, which should stay at zero:

        >>> class LineTask(Task):
        ...     obs_size: ClassVar[int] = 2
        ...     action_size: ClassVar[int] = 1
        ...     action_low: ClassVar[tuple[float, ...]] = (-1.0,)
        ...     action_high: ClassVar[tuple[float, ...]] = (1.0,)
        ...
        ...     def reward(self, obs, action, next_obs):
        ...         return -jnp.square(next_obs[..., 0])
    """

    obs_size: ClassVar[int]
    action_size: ClassVar[int]
    action_low: ClassVar[tuple[float, ...]]
    action_high: ClassVar[tuple[float, ...]]

    @abc.abstractmethod
    def reward(
        self,
        obs: Float[Array, "*batch obs"],
        action: Float[Array, "*batch action"],
        next_obs: Float[Array, "*batch obs"],
    ) -> Float[Array, "*batch"]:
        """Reward of a transition, equal to what `env.step` returns."""

    def released_reward(
        self,
        obs: Float[Array, "*batch obs"],
        action: Float[Array, "*batch action"],
        next_obs: Float[Array, "*batch obs"],
    ) -> Float[Array, "*batch"]:
        """Reward that the released code plans with; differs where that lags or errs."""
        return self.reward(obs, action, next_obs)

    def terminated(
        self,
        obs: Float[Array, "*batch obs"],
        action: Float[Array, "*batch action"],
        next_obs: Float[Array, "*batch obs"],
    ) -> Bool[Array, "*batch"]:
        """Whether the transition ends the episode for good. The paper's tasks never end."""
        del action, next_obs
        return jnp.zeros(obs.shape[:-1], dtype=bool)

    def preprocess(self, obs: Float[Array, "*batch obs"]) -> Float[Array, "*batch features"]:
        """Turn an observation into the features that enter a network."""
        return obs

    def target(
        self, obs: Float[Array, "*batch obs"], next_obs: Float[Array, "*batch obs"]
    ) -> Float[Array, "*batch obs"]:
        """The regression target `delta` of a transition."""
        return next_obs - obs

    def postprocess(
        self, obs: Float[Array, "*batch obs"], delta: Float[Array, "*batch obs"]
    ) -> Float[Array, "*batch obs"]:
        """Undo `target`: `postprocess(obs, target(obs, next_obs)) == next_obs`."""
        return obs + delta

    def scale_action(self, action: Float[Array, "*batch action"]) -> Float[Array, "*batch action"]:
        """Map an action from [-1, 1] to the environment's own units."""
        low, high = jnp.asarray(self.action_low), jnp.asarray(self.action_high)
        return low + 0.5 * (action + 1.0) * (high - low)

    def unscale_action(
        self, action: Float[Array, "*batch action"]
    ) -> Float[Array, "*batch action"]:
        """Map an action from the environment's own units to [-1, 1]."""
        low, high = jnp.asarray(self.action_low), jnp.asarray(self.action_high)
        return 2.0 * (action - low) / (high - low) - 1.0

    def clip_action(self, action: Float[Array, "*batch action"]) -> Float[Array, "*batch action"]:
        """Limit an action in the environment's own units to its range, as the envs do."""
        return jnp.clip(action, jnp.asarray(self.action_low), jnp.asarray(self.action_high))

    @property
    def feature_size(self) -> int:
        """Width of `preprocess`'s result."""
        return eqx.filter_eval_shape(self.preprocess, np.zeros(self.obs_size, np.float32)).shape[-1]
