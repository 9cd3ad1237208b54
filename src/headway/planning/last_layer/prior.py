"""What heads should expect to learn in an episode: empirical Bayes on the training data.

Every collected episode is a task of its own, in which the correction of `regression` is drawn
from the prior. Its residuals are then jointly Gaussian, for each dimension o

    r_o ~ N(0, σ_o² (N + ρ Φ Φᵀ)),

with Φ the features of all transitions and N the relative noise. The prior is the (ρ, σ²) of each
member under which the residuals of all training episodes are most likely (type-II maximum
likelihood; MacKay, 1992). σ² has a closed form for every ρ, so only ρ is searched for.
"""

from collections.abc import Callable, Iterable, Iterator, Sequence
from typing import Literal, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Int
from threadpoolctl import threadpool_limits

from headway.data import Episodes, Trajectory
from headway.models.dynamics import MultiHeadDynamics, Statistics
from headway.planning.last_layer.regression import MAX_LOG_NOISE, Prior, Seen, see_episode
from headway.tasks.base import Task

RATIOS = np.geomspace(1e-7, 1e7, 281)
"""Ratios of prior to noise variance that are tried."""
MAX_EPISODES = 100
"""Episodes that are looked at, evenly spread over those collected; the paper's are all."""
MIN_NOISE = 1e-10
"""Least variance of the noise, in normalised units."""

Rank = Literal["owner", "runner-up"]


class Evidence(NamedTuple):
    """What the likelihood of some episodes depends on, one row per episode (member fixed).

    From the eigenvalues of ΦᵀN⁻¹Φ and the projections of ΦᵀN⁻¹r on its eigenvectors.
    """

    eigenvalues: Float[np.ndarray, "episode feature"]
    projected: Float[np.ndarray, "episode feature obs"]
    squares: Float[np.ndarray, "episode obs"]
    """Sum of squared residuals over the relative noise."""
    log_noise: Float[np.ndarray, " episode"]
    """Sum of the logarithms of the relative noise."""
    steps: Int[np.ndarray, " episode"]

    @classmethod
    def of(cls, rows: Sequence[tuple[np.ndarray, np.ndarray, np.ndarray]]) -> "Evidence":
        """Reduce episodes to what their likelihood depends on.

        Args:
            rows: Features [time, feature], residuals [time, obs] and relative noise [time] of
                each episode, in float64.
        """
        parts = []
        for features, residual, noise in rows:
            whitened = features / noise[:, None]
            values, vectors = np.linalg.eigh(features.T @ whitened)
            projected = vectors.T @ (whitened.T @ residual)
            squares = (np.square(residual) / noise[:, None]).sum(0)
            parts.append(
                (np.maximum(values, 0), projected, squares, np.log(noise).sum(), len(noise))
            )
        return cls(*(np.stack(column) for column in zip(*parts, strict=True)))

    @classmethod
    def joined(cls, parts: Sequence["Evidence"]) -> "Evidence":
        """The same of all their episodes."""
        return cls(*(np.concatenate(column) for column in zip(*parts, strict=True)))

    def noise(self, ratio: float) -> Float[np.ndarray, " obs"]:
        """The most likely variance of the noise under a ratio."""
        shrunk = ratio / (1.0 + ratio * self.eigenvalues)
        explained = (np.square(self.projected) * shrunk[..., None]).sum((0, 1))
        return np.maximum((self.squares.sum(0) - explained) / self.steps.sum(), MIN_NOISE)

    def log_likelihood(self, ratio: float) -> float:
        """Log-density of all residuals under a ratio and its most likely noise."""
        noise, steps = self.noise(ratio), self.steps.sum()
        log_volume = np.log1p(ratio * self.eigenvalues).sum() + self.log_noise.sum()
        per_dimension = steps * (np.log(2.0 * np.pi * noise) + 1.0) + log_volume
        return float(-0.5 * per_dimension.sum())

    def best_ratio(self) -> float:
        """The ratio, among `RATIOS`, of the highest likelihood."""
        return float(max(RATIOS, key=self.log_likelihood))


def fit_prior(
    model: MultiHeadDynamics,
    task: Task,
    statistics: Statistics,
    trajectories: Sequence[Trajectory],
    *,
    history_length: int,
    head_noise: bool = False,
    rank: Rank = "owner",
) -> Prior:
    """Choose the prior under which the training episodes are most likely.

    Args:
        model: The dynamics model, as trained on these episodes.
        task: How observations enter and leave it.
        statistics: The normalisers in use.
        trajectories: Episodes under training physics; which physics is not looked at.
        history_length: Past transitions that the context is made of (K).
        head_noise: Whether the relative noise follows the heads' own variance.
        rank: Whose residuals: of the head that explains an episode best, or second best, as if
            no head had been made for its physics.
    """
    chosen = [trajectories[i] for i in _spread(len(trajectories), MAX_EPISODES)]
    longest = max(len(t) for t in chosen)
    members = range(model.num_members)

    def looks() -> Iterator[list[_OfMember]]:
        """One episode after the other, so that the features of no two are ever held."""
        for trajectory in chosen:
            episode = Episodes.pad([trajectory], 1, longest, model.sim_param_names)
            found = _look(model, task, statistics, episode, history_length)
            steps = slice(len(trajectory))
            seen = jax.tree.map(lambda x, s=steps: np.asarray(x[s]), found)
            yield [_of_member(seen, member, rank) for member in members]

    # Small matrices, one after the other: BLAS threads only wait for each other, and for long
    # where the cores have other work too.
    with threadpool_limits(1, user_api="blas"):
        return _most_likely(looks, len(members), head_noise=head_noise)


class _OfMember(NamedTuple):
    """One episode through one head of one member."""

    features: Float[np.ndarray, "time feature"]
    residual: Float[np.ndarray, "time obs"]
    logvar: Float[np.ndarray, " time"]


def _of_member(seen: Seen, member: int, rank: Rank) -> _OfMember:
    """The episode as the head of a rank sees it, by the summed squared error."""
    residual = np.asarray(seen.residual[:, member], np.float64)
    order = np.argsort(np.square(residual).sum((0, 2)), kind="stable")
    head = order[min(int(rank == "runner-up"), len(order) - 1)]
    logvar = np.zeros(len(residual))
    if seen.logvar is not None:
        logvar = np.asarray(seen.logvar[:, member, head], np.float64).mean(-1)
    return _OfMember(np.asarray(seen.features[:, member], np.float64), residual[:, head], logvar)


def _most_likely(
    looks: Callable[[], Iterator[list[_OfMember]]], num_members: int, *, head_noise: bool
) -> Prior:
    """The prior of every member; where the noise is relative, in two looks at the episodes."""
    used = _mean_logvar(map(_claims, looks())) if head_noise else [None] * num_members
    parts, claims = [], []
    for episode in looks():
        parts.append([*map(_reduced, episode, used)])
        claims.append(_claims(episode))
    references, priors = _mean_logvar(claims), []
    for member in range(num_members):
        evidence = Evidence.joined([episode[member] for episode in parts])
        ratio = evidence.best_ratio()
        priors.append((ratio, evidence.noise(ratio), references[member]))
    columns = (np.stack(column) for column in zip(*priors, strict=True))
    return Prior(*(jnp.asarray(column, jnp.float32) for column in columns))


def _claims(episode: list[_OfMember]) -> list[tuple[float, int]]:
    """Sum and number of the log-variances that each member's head claims in an episode."""
    return [(one.logvar.sum(), len(one.logvar)) for one in episode]


def _mean_logvar(claims: Iterable[list[tuple[float, int]]]) -> list[float]:
    """What each member's heads claim on average over episodes, as a log-variance."""
    sums = np.asarray([*claims], np.float64).sum(0)
    return (sums[:, 0] / sums[:, 1]).tolist()


def _reduced(episode: _OfMember, reference: float | None) -> Evidence:
    """What the likelihood of one episode depends on; its noise is relative to a reference."""
    relative = np.zeros(len(episode.logvar))
    if reference is not None:
        relative = np.clip(episode.logvar - reference, -MAX_LOG_NOISE, MAX_LOG_NOISE)
    return Evidence.of([(episode.features, episode.residual, np.exp(relative))])


@eqx.filter_jit
def _look(
    model: MultiHeadDynamics,
    task: Task,
    statistics: Statistics,
    episode: Episodes,
    history_length: int,
) -> Seen:
    """All transitions of an episode, each with the context of the moment after it."""
    moments = jnp.arange(episode.action.shape[1]) + 1
    return see_episode(model, task, statistics, episode, 0, moments, history_length)


def _spread(count: int, most: int) -> list[int]:
    """At most so many indices, evenly spread."""
    return sorted({*np.linspace(0, count - 1, min(count, most)).round().astype(int).tolist()})
