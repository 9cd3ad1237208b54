"""Steps of an optimiser, none of which is taken with a number that is not finite."""

import functools
from collections.abc import Callable
from typing import Any, NamedTuple, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
import optax
from jaxtyping import Array, Bool, Float, Int

from headway.models.losses import sum_of_squares

State = TypeVar("State")


class EpochStats(NamedTuple):
    """Averages over the updates of one epoch."""

    loss: Float[Array, ""]
    """What was minimised, over the updates that were taken."""
    forward_loss: Float[Array, ""]
    """The part of it that predicts forwards in time."""
    skipped: Int[Array, ""]
    """Updates that were not taken, because a number was not finite."""
    updates: Int[Array, ""]
    """All updates, skipped ones included."""


def unless_broken(
    step: Callable[[], State], state: State, loss: Float[Array, ""], grads: Any
) -> tuple[State, Bool[Array, ""]]:
    """Take a step, unless the loss, or the norm of the gradient, is not a finite float32.

    On a CPU it is a branch: choosing between old and new numbers costs as much as the step itself,
    for both are read and written again. Where seeds are trained together XLA makes a choice of it.

    Args:
        step: Gives the new state.
        state: The old one.
        loss: What is minimised.
        grads: Its gradient, any tree of arrays.

    Returns:
        The new state or the old one, and whether the step was skipped.
    """
    size = sum((sum_of_squares(leaf) for leaf in jax.tree.leaves(grads)), jnp.zeros(()))
    finite = jnp.isfinite(loss) & jnp.isfinite(size)
    if jax.default_backend() == "cpu":
        # In this order: with the branches exchanged XLA copies weights and moments.
        return jax.lax.cond(finite, step, lambda: state), ~finite
    return jax.tree.map(functools.partial(jnp.where, finite), step(), state), ~finite


class Fitted(NamedTuple):
    """What fitting changes: a network and Adam's moments, which persist over iterations."""

    model: Any
    optimizer: optax.OptState

    @classmethod
    def new(cls, model: Any, learning_rate: float) -> "Fitted":
        """Start fitting a network."""
        return cls(model, optax.adam(learning_rate).init(model))

    def step(
        self, loss: Float[Array, ""], grads: Any, learning_rate: float
    ) -> tuple["Fitted", Bool[Array, ""]]:
        """Take one Adam step, unless the loss or the gradient is not finite.

        Returns:
            The new state, and whether the step was skipped.
        """

        def taken() -> Fitted:
            changes, optimizer = optax.adam(learning_rate).update(grads, self.optimizer)
            return Fitted(eqx.apply_updates(self.model, changes), optimizer)

        return unless_broken(taken, self, loss, grads)


class Tally(NamedTuple):
    """Sums over the updates of an epoch."""

    loss: Float[Array, ""]
    skipped: Int[Array, ""]
    updates: Int[Array, ""]

    @classmethod
    def zero(cls) -> "Tally":
        """Before the first update."""
        none = jnp.zeros((), jnp.int32)
        return cls(jnp.zeros(()), none, none)

    def add(self, loss: Float[Array, ""], skipped: Bool[Array, ""]) -> "Tally":
        """Count one update."""
        return Tally(
            self.loss + jnp.where(skipped, 0.0, loss), self.skipped + skipped, self.updates + 1
        )

    @property
    def stats(self) -> EpochStats:
        """Averages over the updates that were not skipped."""
        mean = self.loss / jnp.maximum(self.updates - self.skipped, 1)
        return EpochStats(mean, mean, self.skipped, self.updates)
