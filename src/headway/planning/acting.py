"""What every agent keeps to, and the agent that acts at random."""

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple, Protocol, runtime_checkable

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, PRNGKeyArray

from headway.task import Task

Physics = Sequence[Mapping[str, float]]
"""Simulator parameters of each environment, by name."""


class Decision(NamedTuple):
    """What an agent decided in one step."""

    action: Float[Array, "env action"]
    """The action to take, in [-1, 1]."""
    heads: Int[Array, "env member"] | None
    """The head each member plans with; with `average`, the one that would be adaptive. None
    where a model has no heads."""
    failures: Int[Array, " env"]
    """Planner iterations without any finite return."""
    evaluations: Int[Array, " env"]
    """Candidates whose return was imagined, each with `num_particles` rollouts."""


@runtime_checkable
class ActingState(Protocol):
    """What an agent remembers; a pytree whose arrays lead with the environments."""

    @property
    def action(self) -> Float[Array, "env action"]:
        """The last actions, in [-1, 1]."""
        ...


@runtime_checkable
class Acting(Protocol):
    """Acts in many environments at once, each with its own physics."""

    @property
    def task(self) -> Task:
        """What the agent knows of the environment."""
        ...

    @property
    def sim_param_names(self) -> tuple[str, ...]:
        """The true simulator parameters that the agent must be told; mostly none."""
        ...

    def init(self, num_envs: int, *, key: PRNGKeyArray, sim_params: Physics | None = None) -> Any:
        """Remember nothing yet; returns an `ActingState`.

        Args:
            num_envs: How many environments.
            key: The agent's draws.
            sim_params: The true simulator parameters of each environment, for an agent that is
                told some.
        """
        ...

    def act(self, state: Any, obs: Float[Array | np.ndarray, "env obs"]) -> tuple[Any, Decision]:
        """Choose the next action of every environment."""
        ...


class RandomState(NamedTuple):
    """The last actions, and the random stream."""

    action: Float[Array, "env action"]
    key: PRNGKeyArray


class RandomAgent(eqx.Module):
    """Draws uniform actions."""

    task: Task
    sim_param_names = ()
    method = "random"

    def init(
        self, num_envs: int, *, key: PRNGKeyArray, sim_params: Physics | None = None
    ) -> RandomState:
        """See `Acting.init`."""
        del sim_params
        return RandomState(jnp.zeros((num_envs, self.task.action_size)), key)

    def act(
        self, state: RandomState, obs: Float[Array | np.ndarray, "env obs"]
    ) -> tuple[RandomState, Decision]:
        """See `Acting.act`."""
        key, draw = jax.random.split(state.key)
        action = jax.random.uniform(draw, (len(obs), self.task.action_size), minval=-1.0)
        none = jnp.zeros(len(obs), jnp.int32)
        return RandomState(action, key), Decision(action, None, none, none)
