"""How well heads are selected, and how well a model knows its own error, on test episodes.

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
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray
from scipy import stats

from headway.data import Trajectory, sim_params_row
from headway.planning.agent import Agent, choose_heads, encode
from headway.planning.heads import RecentTransitions
from headway.planning.last_layer.learning import Learned, learn
from headway.planning.last_layer.regression import Seen, foresee

LEVELS = (0.5, 0.9, 0.95)  # central intervals that are counted


@dataclasses.dataclass(frozen=True)
class EpisodeSelection:
    """What all heads predicted in one episode, from its second step on."""

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

    @property
    def chosen_errors(self) -> Float[np.ndarray, "step member"]:
        """The errors of the selected heads."""
        return np.take_along_axis(self.errors, self.chosen[..., None], axis=-1)[..., 0]

    @property
    def best_errors(self) -> Float[np.ndarray, "step member"]:
        """The errors of the best head in hindsight."""
        return np.take_along_axis(self.errors, self.best[None, :, None], axis=-1)[..., 0]

    def settling(self, window: int) -> Float[np.ndarray, " member"]:
        """Transitions that are seen before the best head is chosen `window` times in a row.

        NaN for a member that never gets that far.
        """
        right = self.chosen == self.best
        if len(right) < window:
            return np.full(right.shape[1], np.nan)
        runs = np.lib.stride_tricks.sliding_window_view(right, window, axis=0).all(-1)
        first = runs.argmax(0) + 1.0  # the first selection has seen one transition
        return np.where(runs.any(0), first, np.nan)


@dataclasses.dataclass(frozen=True)
class Calibration:
    """Whether the truth falls where the predicted variance says."""

    mean_square: float
    """Mean square of the error in predicted standard deviations: 1 is right, more means that the
    model is too sure."""
    inside: Mapping[float, float]
    """Share of the truth inside the central interval of each level; the level itself is right."""


@dataclasses.dataclass(frozen=True)
class SelectionSummary:
    """How heads were selected over some episodes; errors are means over steps and members."""

    episodes: int
    head_errors: Float[np.ndarray, "member head"]
    """Error of every head."""
    chosen_error: float
    """Error of the selected heads."""
    best_error: float
    """Error of the best head of each episode and member, in hindsight."""
    average_error: float
    """Error of a head chosen blindly."""
    wrong: float
    """Share of selections that are not the best head in hindsight."""
    settling: float | None
    """Median number of transitions seen before selection settles; None if it never does."""
    settled: float
    """Share of episodes and members in which it settles."""
    calibration: Calibration | None
    """None for a model that predicts no variance."""

    @property
    def regret(self) -> float:
        """What selecting costs against the best head in hindsight; below 0 where switching pays."""
        return self.chosen_error - self.best_error


def examine(
    agent: Agent, trajectories: Sequence[Trajectory], *, key: PRNGKeyArray
) -> list[EpisodeSelection]:
    """Predict every transition of some episodes with every head, as the agent would have.

    Args:
        agent: The agent whose model and selection are examined.
        trajectories: The episodes; those of a single transition are left out.
        key: Draws of a selection that is random or sampled.
    """
    chosen = [trajectory for trajectory in trajectories if len(trajectory) > 1]
    longest = max((len(trajectory) for trajectory in chosen), default=0)
    return [
        _examine(agent, trajectory, longest, jax.random.fold_in(key, i))
        for i, trajectory in enumerate(chosen)
    ]


def _examine(
    agent: Agent, trajectory: Trajectory, longest: int, key: PRNGKeyArray
) -> EpisodeSelection:
    steps = len(trajectory)
    padding = ((0, longest - steps), (0, 0))
    obs = jnp.asarray(np.pad(trajectory.obs, padding, "edge"))
    action = jnp.asarray(np.pad(trajectory.action, padding, "edge"))
    told, names = None, agent.sim_param_names
    if names:
        told = jnp.broadcast_to(sim_params_row(trajectory.sim_params, names), (longest, len(names)))
    found = _predict(agent, obs, action, told, key)
    errors, chosen, deviations = jax.tree.map(lambda x: np.asarray(x)[1:steps], found)
    if deviations is not None:
        varies = np.asarray(agent.statistics.delta.std) > 0
        deviations = deviations[..., varies]
    return EpisodeSelection(trajectory.sim_params, errors, chosen, deviations)


@eqx.filter_jit
def _predict(
    agent: Agent,
    obs: Float[Array, "time_plus_1 obs"],
    action: Float[Array, "time action"],
    sim_params: Float[Array, "time sim_param"] | None,
    key: PRNGKeyArray,
) -> tuple[
    Float[Array, "time member head"],
    Int[Array, "time member"],
    Float[Array, "time member obs"] | None,
]:
    """Errors of all heads, the selected ones, and the latter's errors in standard deviations."""
    recent = _pasts(agent, obs, action)
    context = encode(agent, recent, sim_params)
    transition = obs[:-1], action, obs[1:]
    seen = Seen.through(agent.model, agent.task, agent.statistics, transition, context)
    chosen, foreseen = _live(agent, recent, context, seen, key)
    difference = seen.residual - foreseen
    errors = jnp.square(difference).mean(-1)
    if seen.logvar is None:
        return errors, chosen, None

    def of_chosen(values: Float[Array, "time member head obs"]) -> Float[Array, "time member obs"]:
        return jnp.take_along_axis(values, chosen[:, :, None, None], axis=2)[:, :, 0]

    std = jnp.exp(0.5 * of_chosen(seen.logvar))
    return errors, chosen, of_chosen(difference) / std


def _live(
    agent: Agent,
    recent: RecentTransitions,
    context: Float[Array, "member time context"] | None,
    seen: Seen,
    key: PRNGKeyArray,
) -> tuple[
    Int[Array, "time member"],
    Float[Array, "time member head obs"],
]:
    """Go through an episode as the agent does: learn from each step, then select.

    Args:
        agent: The agent.
        recent: What it remembers before each step; steps take the place of environments.
        context: The context at each step.
        seen: The transition that each step leads to.
        key: Draws of a selection that is random or sampled.

    Returns:
        The selected heads, and how much the heads' corrections add to what they predict; 0 for
        heads that do not learn.
    """
    steps = jnp.arange(len(recent.count))

    def step(learned: Learned, time: Int[Array, ""]):
        now, known = jax.tree.map(lambda x: x[time][None], (recent, seen))
        told = None if context is None else context[:, time][:, None]
        learned = learn(agent, learned, now, told, time[None] > 0)
        head_key, error_key = jax.random.split(jax.random.fold_in(key, time))
        heads = choose_heads(agent, now, told, error_key=error_key, head_key=head_key)
        added = jnp.zeros_like(known.residual)
        if learned.layer is not None:
            added = foresee(learned.layer, known.features)
        return learned, (heads[0], added[0])

    return jax.lax.scan(step, Learned.nothing(agent, 1), steps)[1]


def _pasts(
    agent: Agent, obs: Float[Array, "time_plus_1 obs"], action: Float[Array, "time action"]
) -> RecentTransitions:
    """What the agent remembers before each step of an episode; steps take the place of envs."""
    slots = max(agent.history_length, agent.planner.selection_length)
    steps = jnp.arange(len(action))
    index = jnp.maximum(steps[:, None] - slots + jnp.arange(slots), 0)
    return RecentTransitions(obs[index], action[index], obs[index + 1], steps.astype(jnp.int32))


def summarise(episodes: Sequence[EpisodeSelection], window: int) -> SelectionSummary:
    """Average over episodes; each step of each episode and member counts once.

    Args:
        episodes: At least one.
        window: Right selections in a row after which selection has settled.
    """
    errors = np.concatenate([episode.errors for episode in episodes])
    settling = np.concatenate([episode.settling(window) for episode in episodes])
    settled = ~np.isnan(settling)
    wrong = np.concatenate([episode.chosen != episode.best for episode in episodes])
    return SelectionSummary(
        len(episodes),
        errors.mean(0),
        float(np.concatenate([episode.chosen_errors for episode in episodes]).mean()),
        float(np.concatenate([episode.best_errors for episode in episodes]).mean()),
        float(errors.mean()),
        float(wrong.mean()),
        float(np.median(settling[settled])) if settled.any() else None,
        float(settled.mean()),
        _calibration(episodes),
    )


def _calibration(episodes: Sequence[EpisodeSelection]) -> Calibration | None:
    found = [e.deviations.ravel() for e in episodes if e.deviations is not None]
    if not found:
        return None
    deviations = np.abs(np.concatenate(found).astype(np.float64))
    inside: dict[float, float] = {}
    for level in LEVELS:
        within: Bool[np.ndarray, " sample"] = deviations <= stats.norm.ppf(0.5 + level / 2)
        inside[level] = float(within.mean())
    return Calibration(float(np.square(deviations).mean()), inside)
