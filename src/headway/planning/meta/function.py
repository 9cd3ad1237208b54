"""A model that is one function, so that anything that predicts can be planned with."""

import functools
from collections.abc import Callable
from typing import Any

import equinox as eqx
from jaxtyping import Array, Float

from headway.planning.imagination import over_rows
from headway.planning.meta.models import Transition
from headway.task import Task

Predict = Callable[[Any, Array, Array], Array]
"""Parameters, observations [..., obs] and actions in [-1, 1] [..., action] to next observations."""


class FunctionModel(eqx.Module):
    """Predicts with a function and remembers nothing (an `AdaptiveModel`).

    `AdaptiveAgent(FunctionModel(parameters, predict), task, planner)` plans with it. One that
    learns from the episode is an `AdaptiveModel` of its own.

    Args:
        parameters: What the function is given: a pytree of arrays, the weights of a network say.
        predict: A pure function that JAX can trace, for any number of leading axes.
        widest: Numbers in its widest layer; decides how much is imagined at once.
    """

    parameters: Any
    predict: Predict = eqx.field(static=True)
    widest: int = eqx.field(static=True, default=256)

    def start(self, num_envs: int) -> tuple[()]:
        """See `AdaptiveModel.start`."""
        del num_envs
        return ()

    def remember(self, memory: tuple[()], transition: Transition) -> tuple[()]:
        """See `AdaptiveModel.remember`."""
        del transition
        return memory

    def dynamics(self, memory: tuple[()], precision: str) -> "FunctionDynamics":
        """See `AdaptiveModel.dynamics`; the function has the precision that it has."""
        del memory, precision
        return FunctionDynamics(self.parameters, self.predict, self.widest)


class FunctionDynamics(eqx.Module):
    """The same for one plan (see `Dynamics`)."""

    parameters: Any
    predict: Predict = eqx.field(static=True)
    widest: int = eqx.field(static=True)
    num_members = 1
    stochastic = False
    per_env = ()

    def of_env(self, part: tuple[()]) -> "FunctionDynamics":
        """See `Dynamics.of_env`."""
        del part
        return self

    def start(self) -> tuple[()]:
        """See `Dynamics.start`."""
        return ()

    def step(
        self,
        task: Task,
        carry: tuple[()],
        obs: Float[Array, "1 obs particle candidate"],
        action: Float[Array, "1 action particle candidate"],
        noise: None,
    ) -> tuple[tuple[()], Float[Array, "1 obs particle candidate"]]:
        """See `Dynamics.step`."""
        del task, noise
        predict = functools.partial(self.predict, self.parameters)
        return carry, over_rows(predict)(obs, action)
