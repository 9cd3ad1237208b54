"""Does it help to adapt the second-last layer too? Errors on training physics never seen before.

    python results/adaptation/second_layer.py RUN --others OTHER_SEED ... --table NAME.csv

A head's last hidden layer is shifted: its biases get `U a`, of a few directions U. Which
directions, the training episodes say: each is explained by a shift of its own, and U are the
principal axes of these shifts. While acting, a and the correction of the last layer are learned
together, in closed form, with the network linearised in a; what is judged is the network that was
really shifted, and beside it the linearised one. How far each part may move is what makes the
training episodes most likely.

Held out are training episodes of other seeds. Nothing unseen is looked at.
"""

import argparse
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from threadpoolctl import threadpool_limits

from headway.config import Config
from headway.data import Episodes, Trajectory
from headway.experiment.learners import Learned
from headway.experiment.loading import load_learned, load_task
from headway.models.multi_headed import MultiHeadDynamics
from headway.planning.last_layer.evidence import Evidence
from headway.planning.last_layer.regression import Seen, see_episode
from headway.storage.records import write_csv
from headway.storage.run_dir import RunDir
from headway.task import Task

MOMENTS = (1, 3, 10, 30, 100)
"""Transitions that are learned from before the next are predicted."""
AHEAD = 20
"""Transitions that are predicted; the quick preset plans as many."""
REACHES = (1e-6, 1e-5, 1e-4, 1e-3, 1e-2, 1e-1, 1.0)
"""Factors of the shifts' variance over training episodes that are tried."""
SHARES = (1.0, 1e-1, 1e-2, 1e-3, 1e-4, 1e-6)
"""Factors of the last layer's own prior that are tried."""
RANKS = ("owner", "runner-up")
COLUMNS = ("run", "arm", "directions", "rank", "learned_from", "rmse", "rmse_linearised")


class Eyes(NamedTuple):
    """A trained model, and what it takes to look at an episode through it."""

    learned: Learned
    task: Task
    history_length: int

    def see(self, trajectory: Trajectory, moments: np.ndarray, shift: np.ndarray) -> Seen:
        """The transitions, with the last hidden layer shifted; [member, hidden]."""
        return _see(*self._of(trajectory, moments), jnp.asarray(shift, jnp.float32))

    def slopes(self, trajectory: Trajectory, moments: np.ndarray) -> np.ndarray:
        """How means follow the shift, [time, member, head, obs, hidden]."""
        return np.asarray(_slopes(*self._of(trajectory, moments)), np.float64)

    def _of(self, trajectory: Trajectory, moments: np.ndarray) -> tuple[Any, ...]:
        fit, statistics = self.learned.fit, self.learned.statistics
        episode = Episodes.pad([trajectory], 1, len(trajectory))
        return fit.model, self.task, statistics, episode, jnp.asarray(moments), self.history_length

    @property
    def shape(self) -> tuple[int, int]:
        """Members and units of the last hidden layer."""
        return self.learned.fit.model.forward_net.hidden[-1].bias.shape


@eqx.filter_jit
def _see(model: MultiHeadDynamics, *rest: Any) -> Seen:
    *rest, shift = rest
    shifted = eqx.tree_at(lambda m: m.forward_net.hidden[-1].bias, model, replace_fn=shift.__add__)
    task, statistics, episode, moments, history_length = rest
    return see_episode(shifted, task, statistics, episode, 0, moments, history_length)


@eqx.filter_jit
def _slopes(model: MultiHeadDynamics, *rest: Any) -> jax.Array:
    bias = model.forward_net.hidden[-1].bias

    def mean(shift: jax.Array) -> jax.Array:
        return -_see(model, *rest, shift).residual

    def along(unit: jax.Array) -> jax.Array:
        tangent = jnp.broadcast_to(unit, bias.shape)
        return jax.jvp(mean, (jnp.zeros_like(bias),), (tangent,))[1]

    return jax.vmap(along, out_axes=-1)(jnp.eye(bias.shape[-1]))


class View(NamedTuple):
    """An episode through one head."""

    member: int
    rank: int
    head: int
    features: np.ndarray
    """[time, feature]"""
    residual: np.ndarray
    """[time, obs]"""
    slopes: np.ndarray
    """[time, obs, hidden]"""

    def along(self, directions: np.ndarray) -> "View":
        """The same, with shifts along some directions only."""
        return self._replace(slopes=self.slopes @ directions)


def views(eyes: Eyes, trajectory: Trajectory, moments: np.ndarray) -> Iterator[View]:
    """The episode through the best and the second-best head of every member."""
    seen = eyes.see(trajectory, moments, np.zeros(eyes.shape))
    slopes = eyes.slopes(trajectory, moments)
    features, residual = (np.asarray(x, np.float64) for x in (seen.features, seen.residual))
    best = np.square(residual).sum((0, 3)).argsort(-1, kind="stable")
    for member, order in enumerate(best):
        for rank, head in enumerate(order[: len(RANKS)]):
            at = slice(None), member, head
            yield View(member, rank, int(head), features[:, member], residual[at], slopes[at])


class Prior(NamedTuple):
    """What an episode is expected to ask of one member."""

    ratio: float
    noise: np.ndarray
    directions: np.ndarray
    """[hidden, direction], of unit length."""
    reach: np.ndarray
    """Prior variance along each direction."""


def principal_shifts(seen: list[View], most: int) -> tuple[np.ndarray, np.ndarray]:
    """Directions that shifts of training episodes take, and their mean squares."""
    scale = np.sqrt(np.mean([np.square(v.residual).mean(0) for v in seen], axis=0))
    rows = [
        (
            (v.slopes / scale[:, None]).reshape(-1, v.slopes.shape[-1]),
            (v.residual / scale).reshape(-1, 1),
            np.ones(v.residual.size),
        )
        for v in seen
    ]
    ratio = Evidence.of(rows).best_ratio()
    eye = np.eye(rows[0][0].shape[1]) / ratio
    shifts = np.stack([np.linalg.solve(x.T @ x + eye, x.T @ y)[:, 0] for x, y, _ in rows])
    values, vectors = np.linalg.eigh(shifts.T @ shifts / len(shifts))
    return vectors[:, ::-1][:, :most], np.maximum(values[::-1][:most], 1e-12)


def covariance(view: View, prior: Prior, rows: slice) -> np.ndarray:
    """Of all residuals of some transitions, the noise included; ordered by dimension."""
    gram = prior.ratio * view.features[rows] @ view.features[rows].T
    blocks = np.kron(np.diag(prior.noise), gram + np.eye(len(gram)))
    slopes = view.slopes[rows].transpose(1, 0, 2).reshape(len(blocks), -1)
    return blocks + slopes * prior.reach @ slopes.T


def log_likelihood(view: View, prior: Prior) -> float:
    """Of a whole episode, without constants."""
    root = np.linalg.cholesky(covariance(view, prior, slice(None)))
    white = np.linalg.solve(root, view.residual.T.reshape(-1))
    return float(-0.5 * white @ white - np.log(np.diag(root)).sum())


def most_likely(seen: list[View], directions: int, *, last_layer: bool) -> Prior:
    """The prior under which a member's training episodes are most likely, among those tried."""
    axes, reach = principal_shifts(seen, max(directions, 1))
    axes, reach = axes[:, :directions], reach[:directions]
    evidence = Evidence.of([(v.features, v.residual, np.ones(len(v.residual))) for v in seen])
    best = evidence.best_ratio()
    if last_layer:
        ratios = [best * share for share in (SHARES if directions else (1.0,))]
        noises = [evidence.noise(ratio) for ratio in ratios]
    else:
        ratios = [1e-12] * len(SHARES)
        noises = [share * evidence.noise(0.0) for share in SHARES]
    tried = [
        Prior(ratio, noise, axes, factor * reach)
        for ratio, noise in zip(ratios, noises, strict=True)
        for factor in (REACHES if directions else (0.0,))
    ]
    few = [v.along(axes) for v in seen]
    return max(tried, key=lambda prior: sum(log_likelihood(view, prior) for view in few))


def learn(view: View, prior: Prior, steps: int) -> tuple[np.ndarray, np.ndarray]:
    """Correction [feature, obs] and shift [hidden] after the first transitions of an episode."""
    rows, few = slice(steps), view.along(prior.directions)
    weights = np.linalg.solve(covariance(few, prior, rows), view.residual[rows].T.reshape(-1))
    by_dimension = weights.reshape(len(prior.noise), -1)
    correction = prior.ratio * (view.features[rows].T @ by_dimension.T) * prior.noise
    slopes = few.slopes[rows].transpose(1, 0, 2).reshape(len(weights), -1)
    return correction, prior.directions @ (prior.reach * (slopes.T @ weights))


def errors(eyes: Eyes, trajectory: Trajectory, priors: list[Prior], steps: int) -> np.ndarray:
    """Mean squared error of the next transitions after learning, [member, rank, shifted]."""
    times = np.arange(len(trajectory))
    moments = np.where(times < steps, times + 1, steps)
    judged = slice(steps, steps + AHEAD)
    members, _ = eyes.shape
    found = np.zeros((members, len(RANKS), 2))
    seen = [*views(eyes, trajectory, moments)]
    learned = {(v.member, v.rank): learn(v, priors[v.member], steps) for v in seen}
    shifts = [np.stack([learned[m, rank][1] for m in range(members)]) for rank in (0, 1)]
    shifted = [eyes.see(trajectory, moments, shift) for shift in shifts]
    for view in seen:
        correction, shift = learned[view.member, view.rank]
        foreseen = view.features @ correction + view.slopes @ shift
        really = shifted[view.rank]
        features = np.asarray(really.features[:, view.member], np.float64)
        left = np.asarray(really.residual[:, view.member, view.head]) - features @ correction
        both = left[judged], (view.residual - foreseen)[judged]
        found[view.member, view.rank] = [np.square(x).mean() for x in both]
    return found


def spread(items: list[Any], most: int) -> list[Any]:
    """At most so many of them, evenly spread."""
    return [items[i] for i in np.linspace(0, len(items) - 1, min(len(items), most)).astype(int)]


def measure(run: RunDir, config: Config, held_out: list[Trajectory], asked: Any) -> list[Any]:
    """All arms on the same held-out episodes."""
    eyes = Eyes(load_learned(run, config), load_task(config), config.model.history_length)
    taught = [
        [*views(eyes, trajectory, np.arange(len(trajectory)) + 1)]
        for trajectory in spread(run.load_data(), asked.training_episodes)
    ]
    name = f"{run.path.parent.name}-{run.path.name}"
    arms = [("last layer", 0, True)]
    arms += [("second-last layer", count, False) for count in asked.directions]
    arms += [("both", count, True) for count in asked.directions]
    rows = []
    for arm, count, last_layer in arms:
        priors = [
            most_likely(
                [v for episode in taught for v in episode if v.member == member],
                count,
                last_layer=last_layer,
            )
            for member in range(eyes.shape[0])
        ]
        for prior in priors:
            print(f"{arm}, {count}: ratio {prior.ratio:.2g}, reach {prior.reach[:3]}", flush=True)
        for steps in MOMENTS:
            squared = np.mean([errors(eyes, t, priors, steps) for t in held_out], axis=(0, 1))
            for rank, both in zip(RANKS, np.sqrt(squared), strict=True):
                row = name, arm, count, rank, steps, *both
                rows.append(dict(zip(COLUMNS, row, strict=True)))
                print(*rows[-1].values(), flush=True)
    return rows


def main() -> None:
    """Learn from training episodes what shifts to expect, and measure what they are good for."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("run", type=Path, help="directory of a finished run")
    parser.add_argument("--others", type=Path, nargs="+", required=True, help="runs of other seeds")
    parser.add_argument("--directions", type=int, nargs="+", default=[2, 8, 32])
    parser.add_argument("--training-episodes", type=int, default=15)
    parser.add_argument("--episodes", type=int, default=5, help="held out, of each other run")
    parser.add_argument("--table", type=Path, help="CSV file to write")
    asked = parser.parse_args()
    run = RunDir(asked.run)
    held_out = [
        trajectory
        for other in asked.others
        for trajectory in RunDir(other).load_data()[-asked.episodes :]
    ]
    with threadpool_limits(1, user_api="blas"):
        rows = measure(run, run.config(), held_out, asked)
    if asked.table:
        write_csv(asked.table, COLUMNS, rows)


if __name__ == "__main__":
    main()
