"""Head selection and calibration, measured on test episodes.

Every transition is predicted by all heads before it happens, with the context, the selection and
the corrections that the agent had at that moment. Errors are mean squares over dimensions in
normalised units.
"""

import dataclasses
from collections.abc import Mapping, Sequence

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, PRNGKeyArray
from scipy import stats

from headway.data import Trajectory, sim_params_row
from headway.models.base import Transition
from headway.models.multi_headed import MultiHeadBelief, MultiHeadModel

LEVELS = (0.5, 0.9, 0.95)  # central intervals that are counted


@dataclasses.dataclass(frozen=True)
class EpisodeSelection:
    """Errors of all heads in one episode, from its second step on."""

    sim_params: Mapping[str, float]
    errors: Float[np.ndarray, "step member head"]
    """Error of every head on the transition that followed."""
    chosen: Int[np.ndarray, "step member"]
    """The selected head."""
    deviations: Float[np.ndarray, "step member dim"] | None
    """Errors of the chosen head's mean, in predicted standard deviations; None for a model that
    predicts no variance."""

    @property
    def best(self) -> Int[np.ndarray, " member"]:
        """The head that would have been best for the whole episode, in hindsight."""
        return self.errors.sum(0).argmin(-1)


@dataclasses.dataclass(frozen=True)
class Calibration:
    """Calibration of the predicted variance."""

    mean_square: float
    """Mean square of the error in predicted standard deviations: 1 is right, more means that the
    model is too sure."""
    inside: Mapping[float, float]
    """Share of the truth inside the central interval of each level; the level itself is right."""


@dataclasses.dataclass(frozen=True)
class SelectionSummary:
    """Head selection over some episodes; errors are means over steps and members."""

    episodes: int
    head_errors: Float[np.ndarray, "member head"]
    """Error of every head."""
    chosen_error: float
    """Error of the selected heads."""
    best_error: float
    """Error of the best head of each episode and member, in hindsight."""
    average_error: float
    """Error of a head chosen blindly."""
    wrong_selections: float
    """Share of selections that are not the best head in hindsight."""
    calibration: Calibration | None
    """None for a model that predicts no variance."""

    @property
    def regret(self) -> float:
        """Cost of selecting against the best head in hindsight; below 0 where switching pays."""
        return self.chosen_error - self.best_error


def examine(
    model: MultiHeadModel, trajectories: Sequence[Trajectory], *, key: PRNGKeyArray
) -> list[EpisodeSelection]:
    """Predict every transition of some episodes with every head, as the agent would have.

    Args:
        model: The agent's, with its selection of heads.
        trajectories: The episodes; those of a single transition are left out.
        key: Draws heads where nothing was observed, and samples of a sampled selection.
    """
    episodes = [trajectory for trajectory in trajectories if len(trajectory) > 1]
    longest = max((len(trajectory) for trajectory in episodes), default=0)
    varies = np.asarray(model.statistics.delta.std) > 0
    found = []
    for i, trajectory in enumerate(episodes):
        steps, told, names = len(trajectory), None, model.sim_param_names
        padding = ((0, longest - steps), (0, 0))
        obs = jnp.asarray(np.pad(trajectory.obs, padding, "edge"))
        action = jnp.asarray(np.pad(trajectory.action, padding, "edge"))
        if names:
            told = jnp.asarray(sim_params_row(trajectory.sim_params, names))[None]
        arrays = _predict(model, obs, action, told, jax.random.fold_in(key, i))
        errors, chosen = (np.asarray(array)[1:steps] for array in arrays[:2])
        deviations = None if arrays[2] is None else np.asarray(arrays[2])[1:steps, :, varies]
        found.append(EpisodeSelection(trajectory.sim_params, errors, chosen, deviations))
    return found


@eqx.filter_jit
def _predict(
    model: MultiHeadModel,
    obs: Float[Array, "time_plus_1 obs"],
    action: Float[Array, "time action"],
    sim_params: Float[Array, "1 sim_param"] | None,
    key: PRNGKeyArray,
) -> tuple[
    Float[Array, "time member head"],
    Int[Array, "time member"],
    Float[Array, "time member obs"] | None,
]:
    """Errors of all heads, the selected ones, and the latter's errors in standard deviations.

    Those of the first step mean nothing, because nothing was observed before it.
    """

    def step(belief: MultiHeadBelief, now):
        time, obs, action, next_obs = jax.tree.map(lambda x: x[None], now)
        transition = Transition(obs, action, next_obs, jnp.ones(1, bool))
        args = model.task, model.statistics, transition[:3], belief.context
        seen, heads = model.net.residuals(*args), belief.heads
        difference = seen.residual[0]
        if belief.last_layer is not None:
            difference = difference - belief.last_layer.correction(seen.features)[0]
        deviation = None
        if seen.logvar is not None:
            scaled = difference * jnp.exp(-0.5 * seen.logvar[0])
            deviation = jnp.take_along_axis(scaled, heads[0][:, None, None], axis=1)[:, 0]
        found = jnp.square(difference).mean(-1), heads[0], deviation
        keys = jax.random.split(jax.random.fold_in(key, time[0] + 1))
        return model.observe(belief, transition, keys), found

    steps = jnp.arange(len(action)), obs[:-1], action, obs[1:]
    return jax.lax.scan(step, model.init_belief(1, sim_params), steps)[1]


def summarise(episodes: Sequence[EpisodeSelection]) -> SelectionSummary:
    """Average over episodes, at least one; each step of each episode and member counts once."""
    errors = np.concatenate([episode.errors for episode in episodes])
    chosen = [np.take_along_axis(e.errors, e.chosen[..., None], -1) for e in episodes]
    best = [np.take_along_axis(e.errors, e.best[None, :, None], -1) for e in episodes]
    wrong = np.concatenate([episode.chosen != episode.best for episode in episodes])
    calibration = None
    seen = [e.deviations.ravel() for e in episodes if e.deviations is not None]
    if seen:
        deviations = np.abs(np.concatenate(seen).astype(np.float64))
        bounds = {level: stats.norm.ppf(0.5 + level / 2) for level in LEVELS}
        inside = {level: float((deviations <= bound).mean()) for level, bound in bounds.items()}
        calibration = Calibration(float(np.square(deviations).mean()), inside)
    return SelectionSummary(
        len(episodes),
        errors.mean(0),
        float(np.concatenate(chosen).mean()),
        float(np.concatenate(best).mean()),
        float(errors.mean()),
        float(wrong.mean()),
        calibration,
    )
