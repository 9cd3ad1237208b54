"""One step of an optimiser that never takes a non-finite one."""

import functools
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import optax
from jaxtyping import Array, Bool, Float, Int

from headway.models.fitting import EpochStats


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
        changes, optimizer = optax.adam(learning_rate).update(grads, self.optimizer)
        stepped = Fitted(eqx.apply_updates(self.model, changes), optimizer)
        finite = jnp.isfinite(loss) & jnp.isfinite(optax.tree.norm(grads))
        return jax.tree.map(functools.partial(jnp.where, finite), stepped, self), ~finite


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
