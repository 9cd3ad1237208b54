"""What a trained model has learned: head shares per physics, error by imagined step."""

from collections import defaultdict
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PRNGKeyArray

from headway.data import Episodes, Trajectory, sim_params_row
from headway.models.dynamics import MultiHeadDynamics, Statistics
from headway.models.fitting import FitSetup, assign_segments
from headway.planning.acting import Physics
from headway.planning.agent import Agent, choose_heads, encode, planning_heads
from headway.planning.heads import RecentTransitions
from headway.planning.imagination import ImaginedDynamics
from headway.planning.returns import follow
from headway.training.run import format_sim_params

NUM_STARTS = 256  # imagined rollouts per group in `prediction_error`


def head_shares(
    model: MultiHeadDynamics,
    statistics: Statistics,
    setup: FitSetup,
    trajectories: list[Trajectory],
    episodes: Episodes,
) -> list[dict[str, Any]]:
    """Share of the segments of each physics that each head of each member owns.

    Args:
        model: As trained so far.
        statistics: Its normalisers.
        setup: Task and settings of fitting.
        trajectories: All data.
        episodes: The same, laid out.

    Returns:
        Rows of `assignments.csv`, without the iteration.
    """
    heads = np.asarray(eqx.filter_jit(assign_segments)(model, setup, episodes, statistics).forward)
    owned = defaultdict(lambda: np.zeros((model.num_members, model.num_heads)))
    for row, trajectory in enumerate(trajectories):
        used = -(-len(trajectory) // setup.segment_length)
        for head in range(model.num_heads):
            count = (heads[:, row, :used] == head).sum(-1)
            owned[format_sim_params(trajectory.sim_params)][:, head] += count
    return [
        {"member": member, "head": head, "sim_params": physics, "share": float(share)}
        for physics, counts in sorted(owned.items())
        for (member, head), share in np.ndenumerate(counts / counts.sum(-1, keepdims=True))
    ]


def prediction_error(
    agent: Agent, trajectories: list[Trajectory], *, key: PRNGKeyArray
) -> Float[np.ndarray, " step"]:
    """Root mean squared error of imagined observations by step, over one planning horizon.

    From evenly spread moments of real episodes the chosen heads predict, without noise, what
    the episode's own actions lead to. Errors are in units of each dimension's standard
    deviation over these episodes; members are averaged over.
    """
    slots = max(agent.history_length, agent.planner.selection_length)

    def imagine(recent, actions, sim_params):
        names = agent.sim_param_names
        rows = [sim_params_row(row, names) for row in sim_params]
        told = jnp.asarray(np.stack(rows)) if names else None
        return _imagine(agent, recent, told, actions, key)

    return imagined_error(
        imagine,
        trajectories,
        agent.planner.horizon,
        slots=slots,
        first=slots,
    )


def imagined_error(
    imagine: Callable[
        [RecentTransitions, Array, Physics], Float[Array, "member start horizon obs"]
    ],
    trajectories: list[Trajectory],
    horizon: int,
    *,
    slots: int,
    first: int,
) -> Float[np.ndarray, " step"]:
    """`prediction_error` of anything that imagines.

    Args:
        imagine: Predicts, from the past of some moments, what actions [start, horizon, action]
            lead to; it may use the true simulator parameters.
        trajectories: Real episodes.
        horizon: Imagined steps.
        slots: Past transitions that `imagine` is given; fewer where an episode is younger.
        first: Steps of an episode before the first moment.
    """
    starts = [(t, s) for t in trajectories for s in range(first, len(t) - horizon + 1)]
    if not starts:
        return np.zeros(0)
    starts = [starts[i] for i in np.linspace(0, len(starts) - 1, NUM_STARTS, dtype=int)]
    std = np.concatenate([t.obs for t in trajectories]).std(0)

    def past(shift: int, name: str):
        rows = [getattr(t, name)[max(s - slots, 0) + shift : s + shift] for t, s in starts]
        missing = [((slots - len(row), 0), (0, 0)) for row in rows]
        return jnp.asarray(np.stack([np.pad(*pair) for pair in zip(rows, missing, strict=True)]))

    def future(shift: int, name: str):
        return np.stack([getattr(t, name)[s + shift : s + horizon + shift] for t, s in starts])

    count = jnp.asarray([min(s, slots) for _, s in starts], jnp.int32)
    recent = RecentTransitions(past(0, "obs"), past(0, "action"), past(1, "obs"), count)
    truth = future(1, "obs")
    physics = [trajectory.sim_params for trajectory, _ in starts]
    imagined = imagine(recent, jnp.asarray(future(0, "action")), physics)
    scaled = (np.asarray(imagined) - truth) / np.where(std > 1e-6, std, np.inf)
    return np.sqrt(np.square(scaled).mean((0, 1, 3)))


@eqx.filter_jit
def _imagine(
    agent: Agent,
    recent: RecentTransitions,
    sim_params: Float[Array, "env sim_param"] | None,
    actions: Float[Array, "env horizon action"],
    key: PRNGKeyArray,
) -> Float[Array, "member env horizon obs"]:
    """Mean prediction of every member along given actions, from many moments at once."""
    head_key, error_key = jax.random.split(key)
    context = encode(agent, recent, sim_params)
    heads = choose_heads(agent, recent, context, error_key=error_key, head_key=head_key)
    folded = planning_heads(agent, heads)
    dynamics = ImaginedDynamics.fold(agent.model, agent.statistics, folded, context)
    return follow(dynamics, agent.task, recent.next_obs[:, -1], actions)
