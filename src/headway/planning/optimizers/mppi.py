"""Model predictive path integral control (MPPI)."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from headway.planning.optimizers.base import Optimizer, colored_noise, rank_non_finite_last


class MPPI(Optimizer):
    """Information-theoretic MPPI, some iterations per step (Williams et al., 2017).

    The plan is the average of all candidates, weighted by exp(return / temperature). The returns
    are standardised by the better half of an iteration's candidates, so one temperature suits
    tasks whose rewards differ in scale, and a few very bad candidates do not matter. The
    candidates' deviation stays `initial_std`. They are clipped to the bounds, and the cost of
    control is what the return says: the method's own term for it, which weighs the noise against
    the mean, is left out, as for a base distribution centred at the mean.
    """

    initial_std: float = 0.5
    noise_beta: float = 2.0
    temperature: float = 0.5

    def ask(self, search, key, iteration=0):
        """See `Optimizer.ask`."""
        mean = search.nominal
        shape = len(mean), self.num_candidates, *mean.shape[1:]
        noise = colored_noise(key, shape, self.noise_beta)
        return jnp.clip(mean[:, None] + search.std[:, None] * noise, -1.0, 1.0)

    def tell(self, search, candidates, returns):
        """See `Optimizer.tell`."""
        returns = rank_non_finite_last(returns)
        weights = softmax_weights(returns, self.temperature)
        found = jnp.isfinite(returns).any(-1)
        average = (weights[..., None, None] * candidates).sum(1)
        return search._replace(
            nominal=jnp.where(found[:, None, None], average, search.nominal),
            non_finite=search.non_finite + ~found,
            evaluations=search.evaluations + self.num_candidates,
        )


def softmax_weights(
    returns: Float[Array, "env candidate"], temperature: float
) -> Float[Array, "env candidate"]:
    """Weights that sum to 1, by the softmax of the standardised returns over a temperature.

    The unit is the better half's deviation from the median: the standard deviation wherever
    returns lie symmetrically, but no bad outlier changes it. Where most candidates are so bad that
    the median is one of them (eight times farther from the best than the upper quartile is), it is
    the median of the others.

    Equal returns weigh the same; a return of -inf weighs nothing, and so do all of them where
    nothing is finite.
    """
    finite = jnp.isfinite(returns)
    known = jnp.where(finite, returns, jnp.nan)
    median, quartile, best = jnp.nanquantile(known, jnp.array([0.5, 0.75, 1.0]), -1, keepdims=True)
    worst = best - 8 * (best - quartile)
    others = jnp.where(known >= worst, known, jnp.nan)
    median = jnp.where(median < worst, jnp.nanmedian(others, -1, keepdims=True), median)
    above = returns - median
    square = jnp.mean(jnp.square(above), axis=-1, keepdims=True, where=finite & (above >= 0))
    logits = above / jnp.where(square > 0, jnp.sqrt(square), 1.0) / temperature
    weights = jax.nn.softmax(jnp.where(finite, logits, -jnp.inf), axis=-1)
    return jnp.where(finite, weights, 0.0)
