"""The improved cross-entropy method (iCEM)."""

import jax.numpy as jnp

from headway.data import where_env
from headway.planning.optimizers.base import (
    Optimizer,
    best_candidates,
    colored_noise,
    moments,
    shift_steps,
)


class ICEM(Optimizer):
    """Cross-entropy method with coloured noise and memory (Pinneri et al., 2020, algorithm 1).

    Candidates are clipped to the bounds. Fewer are drawn in each iteration. A share of the
    elites competes again in the next iteration and, moved on by one step, in the next search;
    they are scored anew, because `score` may be random. In the last iteration the mean competes
    too. The plan is the best elite of the last iteration.
    """

    num_elites: int = 10
    smoothing: float = 0.1
    initial_std: float = 0.5
    noise_beta: float = 2.0
    population_decay: float = 1.25
    kept_elite_fraction: float = 0.3
    unrolled = True

    @property
    def populations(self) -> tuple[int, ...]:
        """Candidates drawn in each iteration."""
        sizes = (self.num_candidates / self.population_decay**i for i in range(self.num_iterations))
        return tuple(max(int(size), 2 * self.num_elites) for size in sizes)

    @property
    def num_kept(self) -> int:
        """Elites that compete once more."""
        return round(self.kept_elite_fraction * self.num_elites)

    def init(self, num_envs, horizon, action_size, obs_size=0):
        """See `Optimizer.init`; all elites are still to be drawn."""
        search = super().init(num_envs, horizon, action_size)
        return search._replace(best=search.nominal)

    def ask(self, search, key, iteration=0):
        """See `Optimizer.ask`: new draws, then the kept elites, with draws for their unknowns."""
        mean, population = search.nominal, self.populations[iteration]
        shape = len(mean), population + self.num_kept, *mean.shape[1:]
        noise = colored_noise(key, shape, self.noise_beta)
        drawn = jnp.clip(mean[:, None] + search.std[:, None] * noise, -1.0, 1.0)
        kept = jnp.where(jnp.isfinite(search.elites), search.elites, drawn[:, population:])
        last = [mean[:, None]] if iteration == self.num_iterations - 1 else []
        return jnp.concatenate([drawn[:, :population], kept, *last], axis=1)

    def tell(self, search, candidates, returns):
        """See `Optimizer.tell`."""
        search = search._replace(evaluations=search.evaluations + candidates.shape[1])
        elites, elite_returns = best_candidates(candidates, returns, self.num_elites)
        finite = jnp.isfinite(elite_returns)
        mean, var = moments(elites, finite)
        keep = self.smoothing
        learned = search._replace(
            nominal=keep * search.nominal + (1.0 - keep) * mean,
            std=keep * search.std + (1.0 - keep) * jnp.sqrt(var),
            elites=jnp.where(finite[..., None, None], elites, jnp.inf)[:, : self.num_kept],
            best=elites[:, 0],
        )
        failed = search._replace(non_finite=search.non_finite + 1)
        return where_env(finite[:, 0], learned, failed)

    def shift(self, search):
        """See `Optimizer.shift`; the mean repeats its last action, the elites' is drawn."""
        mean = jnp.clip(search.nominal, -1.0, 1.0)
        nominal, elites = shift_steps(mean, mean[:, -1:]), shift_steps(search.elites, jnp.inf)
        return self.init(*mean.shape)._replace(nominal=nominal, best=nominal, elites=elites)
