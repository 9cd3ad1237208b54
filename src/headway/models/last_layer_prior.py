"""The prior of heads that keep learning, by validation error on the training episodes.

Each training episode is a task of its own. Residuals are not quite what `last_layer` takes them
for, a linear function of the features and independent noise: there are contacts, heads that are
wrong in a curved way, contexts that move. A prior under which corrections explain a whole episode
can then predict badly. So the prior is the one under which a correction that has learned from the
beginning of an episode best predicts the rest, one horizon ahead.

Chosen are the ratio ρ of prior to noise variance, and the spread of the prior over the features.
With Λ and V the eigenvalues and eigenvectors of their second moment over the training episodes,
the covariance of a correction is σ² ρ V Λ^(-α) Vᵀ / c: for α = 0 all weights are equally uncertain,
and what all features share is learned first and trusted everywhere; for α = 1, Zellner's g-prior,
all directions count as much as they vary. c makes ρ the ratio of variances at an average
transition.

Both the head that explains an episode best and the second best are validated, each in units of
its error without learning. The best is the one that acts on known physics and should lose nothing;
the second best imitates physics that no head was made for, with no data but those of training.

The noise σ² is the most likely one under the prior, for the best heads (type-II maximum
likelihood; MacKay, 1992). Residuals of an episode are jointly Gaussian, r_o ~ N(0, σ_o² K) with
K = I + Φ P₀ Φᵀ and Φ the features of all transitions, so σ_o² is the mean of r_oᵀ K⁻¹ r_o.
"""

from collections.abc import Sequence

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int
from threadpoolctl import threadpool_limits

from headway.data import Episodes, Trajectory
from headway.errors import ConfigError
from headway.models.last_layer import Prior, Residuals
from headway.models.multi_headed import MultiHeadNet
from headway.models.statistics import Statistics
from headway.task import Task

RATIOS = np.geomspace(1e-5, 1e6, 45)
"""Values of ρ that are tried, four in each decade."""
POWERS = (0.0, 0.5, 1.0)
"""Values of α that are tried."""
NOISE_EPISODES, VALIDATION_EPISODES = 100, 25
"""Training episodes that are looked at, evenly spread over those collected; the paper's are 100."""
MOMENTS = 4
"""Moments of each episode, from which the rest is predicted."""
MIN_EIGENVALUE = 1e-5
"""Least eigenvalue of the second moment, as a share of the largest."""
MIN_NOISE = 1e-10
"""Least variance of the noise, in normalised units."""
GOLDEN = (5**0.5 - 1) / 2


def fit_prior(
    model: MultiHeadNet,
    task: Task,
    statistics: Statistics,
    trajectories: Sequence[Trajectory],
    *,
    history_length: int,
    horizon: int,
) -> Prior:
    """Choose the prior that suits the training episodes.

    Args:
        model: The dynamics model, as trained on these episodes.
        task: How observations enter and leave it.
        statistics: The normalisers in use.
        trajectories: Episodes under training physics; which physics is not looked at.
        history_length: Past transitions that the context is made of (K).
        horizon: Transitions ahead that plans look.

    Raises:
        ConfigError: There is no episode.
    """
    if not trajectories:
        raise ConfigError(
            "heads that keep learning got no training episodes, allowed: one or more, from which"
            " their prior is found; pass them, or set planner.adaptation to none."
        )
    chosen = evenly_spread(trajectories, NOISE_EPISODES)
    validated = evenly_spread(chosen, VALIDATION_EPISODES)
    longest = max(map(len, chosen))  # all are padded to it, so that one program serves them

    def see(trajectory: Trajectory, moment: int | None = None) -> tuple[np.ndarray, np.ndarray]:
        """Features and residuals, with the context after each transition or that of a moment."""
        steps = np.arange(longest) + 1 if moment is None else np.full(longest, moment)
        episode = Episodes.pad([trajectory], 1, longest, model.sim_param_names)
        found = residuals_of(model, task, statistics, episode, jnp.asarray(steps), history_length)
        features, residual = (np.asarray(x[: len(trajectory)], np.float64) for x in found[:2])
        return features, residual

    members = range(model.num_members)
    # Small matrices, one after the other: BLAS threads only wait for each other, and for long
    # where the cores have other work too.
    with threadpool_limits(1, user_api="blas"):
        second_moment, steps = np.zeros(()), 0
        for trajectory in validated:
            features, _ = see(trajectory)
            second_moment = second_moment + np.einsum(
                "tmi,tmj->mij", features, features, optimize=True
            )
            steps += len(features)
        roots = [[spread_root(one / steps, power) for power in POWERS] for one in second_moment]

        error, without = np.zeros((len(POWERS), len(RATIOS), 1)), 0.0
        for i, trajectory in enumerate(validated):
            features, residual = see(trajectory)
            heads = best_heads(residual)[:, :2]
            for n in validation_moments(len(trajectory), i):
                later_features, later_residual = see(trajectory, n)
                ahead = slice(n, n + horizon)
                for m in members:
                    learned = features[:n, m], residual[:n, m, heads[m]]
                    future = later_features[ahead, m], later_residual[ahead, m, heads[m]]
                    error = error + [validation_errors(learned, future, root) for root in roots[m]]
                    without = without + np.square(future[1]).mean((0, 2))
        relative = (error / np.maximum(without, MIN_NOISE)).mean(-1)
        # Among equals the smallest ratio wins, which trusts the heads most.
        ratio, power = np.unravel_index(relative.T.argmin(), relative.T.shape)
        root = np.stack([np.sqrt(RATIOS[ratio]) * of_member[power] for of_member in roots])

        squares, steps = np.zeros((model.num_members, task.obs_size)), 0
        for trajectory in chosen:
            features, residual = see(trajectory)
            heads = best_heads(residual)[:, 0]
            steps += len(trajectory)
            for m in members:
                squares[m] += whitened_squares(features[:, m] @ root[m], residual[:, m, heads[m]])
    noise = np.maximum(squares / steps, MIN_NOISE)
    return Prior(jnp.asarray(root, jnp.float32), jnp.asarray(noise, jnp.float32))


@eqx.filter_jit
def residuals_of(
    model: MultiHeadNet,
    task: Task,
    statistics: Statistics,
    episode: Episodes,
    moments: Int[Array, " time"],
    history_length: int,
) -> Residuals:
    """All transitions of one padded episode that can be true; `env` in `Residuals` is time here.

    Args:
        model: The dynamics model.
        task: How observations enter and leave it.
        statistics: The normalisers in use.
        episode: The first row counts.
        moments: For each transition, the step of whose past its context is made.
        history_length: Past transitions that a context is made of (K).
    """
    history = episode.history(jnp.zeros_like(moments), moments, history_length)
    sim_params = jnp.repeat(episode.sim_params[:1], len(moments), axis=0)
    history, sim_params = jax.tree.map(
        lambda x: jnp.broadcast_to(x, (model.num_members, *x.shape)), (history, sim_params)
    )
    context = model.context(history, statistics, sim_params)
    transitions = episode.obs[0, :-1], episode.action[0], episode.obs[0, 1:]
    found = model.residuals(task, statistics, transitions, context)
    return found.gated(jnp.arange(len(moments)) < episode.length[0])._replace(logvar=None)


def best_heads(
    residual: Float[np.ndarray, "time member head obs"],
) -> Int[np.ndarray, "member head"]:
    """Heads in the order in which they explain an episode, by the summed squared error."""
    return np.argsort(np.square(residual).sum((0, 3)), axis=-1, kind="stable")


def spread_root(
    second_moment: Float[np.ndarray, "feature feature"], power: float
) -> Float[np.ndarray, "feature feature"]:
    """R with R Rᵀ = V Λ^(-α) Vᵀ / c."""
    values, vectors = np.linalg.eigh(second_moment)
    values = np.maximum(values, MIN_EIGENVALUE * values.max())
    variances = values**-power
    return vectors * np.sqrt(variances / (variances * values).sum())


def validation_errors(
    learned: tuple[Float[np.ndarray, "step feature"], Float[np.ndarray, "step head obs"]],
    later: tuple[Float[np.ndarray, "ahead feature"], Float[np.ndarray, "ahead head obs"]],
    root: Float[np.ndarray, "feature feature"],
) -> Float[np.ndarray, "ratio head"]:
    """Mean squared error of later transitions after learning, with each ratio of `RATIOS`.

    One decomposition serves all ratios: of ΦΦᵀ or of ΦᵀΦ, whichever is smaller.

    Args:
        learned: Features and residuals of the transitions that are learned from.
        later: The same of those that are predicted.
        root: The prior's spread over the features (R).
    """
    (features, residual), (ahead, target) = learned, later
    features, ahead = features @ root, ahead @ root
    residual = residual.reshape(len(residual), -1)
    if len(features) > features.shape[1]:
        values, vectors = np.linalg.eigh(features.T @ features)
        told, seen = vectors.T @ (features.T @ residual), ahead @ vectors
    else:
        values, vectors = np.linalg.eigh(features @ features.T)
        told, seen = vectors.T @ residual, ahead @ features.T @ vectors
    shrunk = RATIOS[:, None] / (1.0 + RATIOS[:, None] * np.maximum(values, 0.0))
    predicted = ((seen * shrunk[:, None]) @ told).reshape(-1, *target.shape)
    return np.square(target - predicted).mean((1, 3))


def whitened_squares(
    features: Float[np.ndarray, "time feature"], residual: Float[np.ndarray, "time obs"]
) -> Float[np.ndarray, " obs"]:
    """rᵀ K⁻¹ r with K = I + Φ Φᵀ, the prior's root being in the features already."""
    gram = features.T @ features
    explained = features @ np.linalg.solve(np.eye(len(gram)) + gram, features.T @ residual)
    return (residual * (residual - explained)).sum(0)


def validation_moments(length: int, episode: int) -> list[int]:
    """Moments of an episode after the first transition and before the last, log-uniform.

    One lies in each of `MOMENTS` equal parts of the logarithm, elsewhere in each episode.
    """
    shift = (GOLDEN * (episode + 1)) % 1.0
    found = [int(length ** ((part + shift) / MOMENTS)) for part in range(MOMENTS)]
    return [min(max(moment, 1), length - 1) for moment in found if length > 1]


def evenly_spread(items: Sequence[Trajectory], most: int) -> list[Trajectory]:
    """At most so many, evenly spread."""
    count = len(items)
    return [items[i] for i in np.linspace(0, count - 1, min(count, most)).round().astype(int)]
