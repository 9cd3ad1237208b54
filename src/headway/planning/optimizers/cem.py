"""The cross-entropy method, as the paper plans with it."""

import jax
import jax.numpy as jnp

from headway.planning.optimizers.base import Optimizer, best_candidates, moments


class CEM(Optimizer):
    """Cross-entropy method with clipped variance and smoothing (PETS; released `core/utils.py`).

    It plans the final mean, not the best candidate.
    """

    num_elites: int = 50
    smoothing: float = 0.1
    initial_std: float = 0.5
    narrow_at_bounds: bool = False

    def ask(self, search, key, iteration=0):
        """See `Optimizer.ask`: a normal truncated at two deviations, and clipped to ±1.

        The paper narrows it instead, until ±1 is two deviations away. Near a bound hardly
        anything else is drawn then, and a plan stays there after what is best has changed.
        """
        mean, std = search.nominal, search.std
        if self.narrow_at_bounds:
            room = jnp.minimum((mean + 1) / 2, (1 - mean) / 2)
            std = jnp.minimum(jnp.abs(room), std)
        shape = len(mean), self.num_candidates, *mean.shape[1:]
        draws = jax.random.truncated_normal(key, -2.0, 2.0, shape)
        return jnp.clip(mean[:, None] + std[:, None] * draws, -1.0, 1.0)

    def tell(self, search, candidates, returns):
        """See `Optimizer.tell`: elites are the best candidates, of a finite return only."""
        elites, elite_returns = best_candidates(candidates, returns, self.num_elites)
        finite = jnp.isfinite(elite_returns)
        mean, var = moments(elites, finite)
        # Keep a share of the old distribution; keep all of it where nothing was finite.
        found = finite.any(-1)
        keep = jnp.where(found[:, None, None], self.smoothing, 1.0)
        return search._replace(
            nominal=keep * search.nominal + (1.0 - keep) * mean,
            std=jnp.sqrt(keep * jnp.square(search.std) + (1.0 - keep) * var),
            non_finite=search.non_finite + ~found,
            evaluations=search.evaluations + self.num_candidates,
        )
