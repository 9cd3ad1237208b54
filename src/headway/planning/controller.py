"""One robot's controller: observations in, actions out, in the environment's own units."""

from collections.abc import Mapping

import jax
import numpy as np
from jaxtyping import Float, Int

from headway.errors import ConfigError
from headway.planning.acting import Acting
from headway.tasks.base import Task


class Controller:
    """Acts with a trained agent, one step at a time.

    Args:
        agent: The trained agent.
        seed: Seeds the planner's draws.
    """

    def __init__(self, agent: Acting, *, seed: int = 0):
        self.agent = agent
        self._seed = seed
        self._episode = -1
        self.reset()

    def reset(self, sim_params: Mapping[str, float] | None = None) -> None:
        """Forget the past; call it when an episode begins or the physics may have changed.

        Args:
            sim_params: The true simulator parameters, as in `info["sim_params"]`. Only a model
                with `model.context="sim-params"` looks at them; it cannot act without.

        Raises:
            ConfigError: A simulator parameter that the model is told has no value.
        """
        self._episode += 1
        key = jax.random.fold_in(jax.random.key(self._seed), self._episode)
        self._state = None
        if sim_params is not None or not self.agent.sim_param_names:
            self._state = self.agent.init(1, key=key, sim_params=[sim_params or {}])
        self._heads: Int[np.ndarray, " member"] | None = None

    def act(self, obs: Float[np.ndarray, " obs"]) -> Float[np.ndarray, " action"]:
        """Choose the next action.

        Args:
            obs: The observation, as the environment returned it.

        Returns:
            The action, in the environment's own units and within its bounds.

        Raises:
            ConfigError: The observation has another shape or is not finite, or the model wants
                to be told the simulator parameters and was not.
        """
        if self._state is None:
            names = ", ".join(self.agent.sim_param_names)
            raise ConfigError(
                f"the controller was told no sim_params, allowed: a value for each of {names},"
                ' which its model takes as input; call reset(sim_params=info["sim_params"]) first.'
            )
        task = self.agent.task
        obs = np.asarray(obs)
        if obs.shape != (task.obs_size,):
            raise ConfigError(
                f"obs has shape {obs.shape}, allowed: ({task.obs_size},); pass one observation as"
                " the environment returns it."
            )
        if not np.isfinite(obs).all():
            entry = int(np.argmin(np.isfinite(obs)))
            raise ConfigError(
                f"obs[{entry}] is {obs[entry]}, allowed: finite numbers; check the sensor."
            )
        self._state, decision = self.agent.act(self._state, obs[None].astype(np.float32))
        scaled, heads = jax.device_get((decision.action, decision.heads))
        self._heads = None if heads is None else heads[0]
        return env_action(task, scaled[0])

    @property
    def heads(self) -> Int[np.ndarray, " member"] | None:
        """The prediction head that each member plans with now.

        None before the first action, and where the model has no heads.

        With `head_selection="average"`, which plans with all heads, the one that explains the
        recent past best.
        """
        return self._heads


def env_action(
    task: Task, action: Float[np.ndarray, "*batch action"]
) -> Float[np.ndarray, "*batch action"]:
    """`Task.scale_action` in NumPy, exactly within the environment's bounds."""
    low, high = np.asarray(task.action_low), np.asarray(task.action_high)
    scaled = low + 0.5 * (action.astype(np.float64) + 1.0) * (high - low)
    return np.clip(scaled, low, high).astype(np.float32)
