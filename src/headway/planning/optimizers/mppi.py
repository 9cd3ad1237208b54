"""Model predictive path integral control (MPPI)."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int, PRNGKeyArray

from headway.planning.optimizers.base import Optimizer, Plan, SearchState
from headway.planning.optimizers.noise import colored_noise
from headway.planning.optimizers.ranking import rank_non_finite_last


class MPPI(Optimizer):
    """Information-theoretic MPPI, some iterations per step (Williams et al., 2017).

    The plan is the average of all candidates, weighted by exp(return / temperature). The returns
    are standardised over the candidates of an iteration, so one temperature suits tasks whose
    rewards differ in scale. The candidates' deviation stays `initial_std`. They are clipped to
    the bounds, and the cost of control is what the return says: the method's own term for it,
    which weighs the noise against the mean, is left out, as for a base distribution centred at
    the mean. The expected return is the weighted mean return of the last iteration.
    """

    num_candidates: int = 200
    num_iterations: int = 5
    initial_std: float = 0.5
    noise_beta: float = 2.0
    temperature: float = 0.5

    @property
    def max_evaluations(self) -> int:
        """See `Optimizer.max_evaluations`."""
        return self.num_candidates * self.num_iterations

    def begin(self, state: SearchState) -> "_Search":
        """See `Optimizer.begin`."""
        none = jnp.zeros(len(state.guess), jnp.int32)
        return _Search(state.guess, jnp.zeros(len(state.guess)), none, none)

    def ask(
        self, search: "_Search", key: PRNGKeyArray, iteration: int = 0
    ) -> Float[Array, "env candidate horizon action"]:
        """See `Optimizer.ask`."""
        del iteration  # all are alike
        num_envs, *sequence_shape = search.mean.shape
        shape = (num_envs, self.num_candidates, *sequence_shape)
        noise = colored_noise(key, shape, self.noise_beta)
        return jnp.clip(search.mean[:, None] + self.initial_std * noise, -1.0, 1.0)

    def tell(
        self,
        search: "_Search",
        candidates: Float[Array, "env candidate horizon action"],
        returns: Float[Array, "env candidate"],
    ) -> "_Search":
        """See `Optimizer.tell`."""
        returns = rank_non_finite_last(returns)
        weights = softmax_weights(returns, self.temperature)
        found = jnp.isfinite(returns).any(-1)
        average = (weights[..., None, None] * candidates).sum(1)
        expected = (weights * jnp.where(weights > 0, returns, 0.0)).sum(-1)
        return _Search(
            mean=jnp.where(found[:, None, None], average, search.mean),
            expected=jnp.where(found, expected, -jnp.inf),
            failures=search.failures + ~found,
            evaluations=search.evaluations + self.num_candidates,
        )

    def end(self, search: "_Search") -> Plan:
        """See `Optimizer.end`."""
        actions = jnp.clip(search.mean, -1.0, 1.0)
        ended = SearchState(actions)
        return Plan(actions, search.expected, search.failures, search.evaluations, ended)


class _Search(NamedTuple):
    """A search under way."""

    mean: Float[Array, "env horizon action"]
    expected: Float[Array, " env"]
    failures: Int[Array, " env"]
    evaluations: Int[Array, " env"]


def softmax_weights(
    returns: Float[Array, "env candidate"], temperature: float
) -> Float[Array, "env candidate"]:
    """Weights that sum to 1, by the softmax of the standardised returns over a temperature.

    Equal returns weigh the same; a return of -inf weighs nothing, and so do all of them where
    nothing is finite.
    """
    finite = jnp.isfinite(returns)
    mean = jnp.mean(returns, axis=-1, keepdims=True, where=finite)
    std = jnp.std(returns, axis=-1, keepdims=True, where=finite)
    logits = (returns - mean) / jnp.where(std > 0, std, 1.0) / temperature
    weights = jax.nn.softmax(jnp.where(finite, logits, -jnp.inf), axis=-1)
    return jnp.where(finite, weights, 0.0)
