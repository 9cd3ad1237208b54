"""Random shooting: no learning from one round to the next."""

import jax
import jax.numpy as jnp

from headway.planning.optimizers.base import Optimizer, best_candidates


class RandomShooting(Optimizer):
    """The best of uniformly drawn sequences, drawn in rounds to bound memory.

    The nominal plan is used only where nothing is finite.
    """

    initial_std = 0.0

    def ask(self, search, key, iteration=0):
        """See `Optimizer.ask`."""
        shape = len(search.nominal), self.num_candidates, *search.nominal.shape[1:]
        return jax.random.uniform(key, shape, minval=-1.0, maxval=1.0)

    def tell(self, search, candidates, returns):
        """See `Optimizer.tell`."""
        (best,), (top,) = (x.swapaxes(0, 1) for x in best_candidates(candidates, returns, 1))
        return search._replace(
            nominal=jnp.where((top > search.best_return)[:, None, None], best, search.nominal),
            best_return=jnp.maximum(search.best_return, top),
            non_finite=search.non_finite + ~jnp.isfinite(top),
            evaluations=search.evaluations + self.num_candidates,
        )
