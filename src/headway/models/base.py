"""Model, belief, Dynamics: one way from what was observed to what is imagined.

A *belief* is all that a model knows of each environment: past transitions, a context, chosen
heads, adapted weights, a recurrent state. It is a pytree whose arrays lead with the environments.
A model takes in each transition (`observe`), and specialises itself to a belief (`dynamics`).
Training, plans, diagnostics and films work with any `Model` and never ask which method it is.

Inside a plan the layout is [member, feature, particle, candidate]. Members lead because their
weights differ; candidates come last, so that every elementwise operation, slice and sum over
features runs over long contiguous rows, and what all candidates share is a plain broadcast.
"""

import abc
import dataclasses
import functools
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, Key

from headway.config import Precision
from headway.data import History, where_env
from headway.models.networks import PRECISIONS, Dense, rounded
from headway.task import Task

Keys = Key[Array, "2"]
"""One draws heads at random, the other the noise of sampled errors."""


class Transition(NamedTuple):
    """One step of every environment, and where it happened at all."""

    obs: Float[Array, "env obs"]
    action: Float[Array, "env action"]
    """In [-1, 1]."""
    next_obs: Float[Array, "env obs"]
    happened: Bool[Array, " env"]
    """False at the beginning of an episode, or where the action is not known."""


class Dynamics(eqx.Module):
    """A model specialised to one belief; a pytree, since it goes from one program to the next."""

    own: Any
    """The arrays that differ between environments; these lead."""

    @property
    def widest(self) -> int:
        """Numbers in the widest layer of one step; decides how much is imagined at once.

        What has no layers counts as one of usual width.
        """
        parts = jax.tree.leaves(self, is_leaf=lambda part: isinstance(part, Layer))
        widths = (part.bias.shape[-1] for part in parts if isinstance(part, Layer))
        return max(widths, default=256)

    @property
    def num_members(self) -> int:
        """Models that imagine side by side."""
        return 1

    @property
    def stochastic(self) -> bool:
        """True where `step` uses noise."""
        return False

    def of_env(self, own: Any) -> "Dynamics":
        """The dynamics of one environment, given its part of `own`."""
        return dataclasses.replace(self, own=own)

    def of_member(self, member: Int[Array, ""]) -> "Dynamics":
        """One member of an ensemble; arrays keep that axis. Called after `of_env`."""
        return self

    def start(self) -> Any:
        """State that the rollouts of one environment carry from step to step, [member, size]."""
        return ()

    def outcome(self, carry: Any) -> tuple[Array, Array] | None:
        """Reward, and whether the episode ended, [member, particle, candidate], of the last step.

        None, the default, where the Task computes them.

        Args:
            carry: After that step.
        """
        return None

    @abc.abstractmethod
    def step(
        self,
        carry: Any,
        obs: Float[Array, "member obs particle candidate"],
        action: Float[Array, "member action particle candidate"],
        noise: Float[Array, "member obs particle #candidate"] | None,
    ) -> tuple[Any, Float[Array, "member obs particle candidate"]]:
        """One imagined step of one environment.

        Args:
            carry: From the last step.
            obs: Where each rollout is.
            action: In [-1, 1].
            noise: Standard normal draws; None predicts the mean.

        Returns:
            The next state to carry, and the next observations.
        """


class Model(eqx.Module):
    """A model as it acts, for many environments at once, each with its own physics."""

    traceable = True
    """False for a simulator that JAX cannot trace; its `dynamics` then has a method `returns` of
    candidate action sequences, NumPy in and out, instead of `step`."""

    @property
    def sim_param_names(self) -> tuple[str, ...]:
        """The true simulator parameters that the model must be told; mostly none."""
        return ()

    @property
    def memory(self) -> int | None:
        """Past transitions that a belief depends on at most; None: the whole episode."""
        return None

    def init_belief(
        self, num_envs: int, sim_params: Float[Array, "env sim_param"] | None = None
    ) -> Any:
        """The belief at the beginning of an episode, before the first `observe`; by default none.

        Args:
            num_envs: Number of environments.
            sim_params: The values of `sim_param_names`; None where there are none.
        """
        return ()

    def observe(self, belief: Any, transition: Transition, keys: Keys) -> Any:
        """The belief after a transition, or at a first observation (`happened` is False).

        By default nothing is learned.
        """
        return belief

    @abc.abstractmethod
    def dynamics(self, belief: Any, precision: Precision = "float32") -> Any:
        """The `Dynamics` under a belief.

        Args:
            belief: After `observe`.
            precision: Of what the networks multiply.
        """


class RecentTransitions(NamedTuple):
    """The newest transitions of each environment, the newest in the last slot."""

    obs: Float[Array, "env slot obs"]
    action: Float[Array, "env slot action"]
    next_obs: Float[Array, "env slot obs"]
    count: Int[Array, " env"]

    @classmethod
    def empty(cls, num_envs: int, num_slots: int, task: Task) -> "RecentTransitions":
        """No transitions yet."""
        obs = jnp.zeros((num_envs, num_slots, task.obs_size))
        action = jnp.zeros((num_envs, num_slots, task.action_size))
        return cls(obs, action, obs, jnp.zeros(num_envs, jnp.int32))

    def push(self, transition: Transition) -> "RecentTransitions":
        """Append a transition where it happened; the oldest falls out."""
        obs, action, next_obs = (
            jnp.concatenate([slots[:, 1:], newest[:, None]], axis=1)
            for slots, newest in zip(self[:3], transition[:3], strict=True)
        )
        pushed = RecentTransitions(obs, action, next_obs, self.count + 1)
        return where_env(transition.happened, pushed, self)

    def history(self, length: int) -> History:
        """The last K transitions as the context encoder wants them: filled from the left."""
        used = jnp.minimum(self.count, length)
        slot = (jnp.arange(length) - used[:, None]) % length
        valid = (jnp.arange(length) < used[:, None])[..., None]

        def align(values):
            moved = jnp.take_along_axis(values[:, -length:], slot[..., None], axis=1)
            return jnp.where(valid, moved, 0.0)

        return History(align(self.next_obs - self.obs), align(self.action))


class Layer(NamedTuple):
    """One linear layer of every member; its products run in the weight's precision."""

    weight: Float[Array, "*env member out in"]
    bias: Float[Array, "*env member out"]

    def __call__(
        self, x: Float[Array, "member in particle candidate"]
    ) -> Float[Array, "member out particle candidate"]:
        """Apply each member's layer; sums are always float32."""
        product = jnp.einsum(
            "moi,mipc->mopc",
            self.weight,
            rounded(x, self.weight.dtype),
            preferred_element_type=jnp.float32,
        )
        return product + self.bias[:, :, None, None]


def plan_layers(layers: Sequence[Dense], precision: Precision) -> tuple[Layer, ...]:
    """Lay layers out for a plan; all but the first, which takes observations, in a precision.

    Bfloat16 would not resolve the offsets of raw observations.
    """
    dtypes = [jnp.float32, *[PRECISIONS[precision]] * (len(layers) - 1)]
    return tuple(
        Layer(layer.weight.mT.astype(dtype), layer.bias)
        for layer, dtype in zip(layers, dtypes, strict=True)
    )


def over_rows(function: Callable) -> Callable:
    """Let a Task's method, which wants features last, take [member, feature, *rows]."""
    return jax.vmap(jax.vmap(function, in_axes=-1, out_axes=-1), in_axes=-1, out_axes=-1)


class FunctionModel(Model):
    """Any function as a model: it remembers nothing.

    `Agent(FunctionModel(parameters, predict), task, planner)` plans with it.

    Args:
        parameters: The function's first argument: a pytree of arrays, such as a network's weights.
        predict: `predict(parameters, obs, action)`, pure and traceable by JAX, takes observations
            [..., obs] and actions [..., action] in [-1, 1] to the next observations.
    """

    parameters: Any
    predict: Callable[[Any, Array, Array], Array] = eqx.field(static=True)

    def dynamics(self, belief: tuple[()], precision: Precision = "float32") -> "FunctionDynamics":
        """The function; its precision is its own."""
        return FunctionDynamics(belief, self.parameters, self.predict)


class FunctionDynamics(Dynamics):
    """A function's step."""

    parameters: Any
    predict: Callable[[Any, Array, Array], Array] = eqx.field(static=True)

    def step(self, carry, obs, action, noise):
        """See `Dynamics.step`."""
        return carry, over_rows(functools.partial(self.predict, self.parameters))(obs, action)
