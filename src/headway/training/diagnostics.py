"""Imagined observations against real ones: errors by step, and one episode over time."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, PRNGKeyArray

from headway.data import Trajectory, sim_params_row
from headway.models.base import Keys, Model, RecentTransitions, Transition, live_through
from headway.planning.rollouts import follow

NUM_STARTS = 256  # imagined rollouts per group in `prediction_error`


def prediction_error(
    model: Model, trajectories: list[Trajectory], first: int, horizon: int, key: PRNGKeyArray
) -> Float[np.ndarray, " step"]:
    """Root mean squared error of imagined observations by step.

    From evenly spread moments of real episodes the model predicts, without noise, what the
    episode's own actions lead to, after it has lived through what went before. Errors are in
    units of each dimension's standard deviation over these episodes; members are averaged over.

    Args:
        model: As it was trained.
        trajectories: Real episodes.
        first: Steps of an episode before the first moment.
        horizon: Imagined steps.
        key: Draws of a head selection that is random or sampled.
    """
    starts = [(t, s) for t in trajectories for s in range(first, len(t) - horizon + 1)]
    if not starts:
        return np.zeros(0)
    starts = [starts[i] for i in np.linspace(0, len(starts) - 1, NUM_STARTS, dtype=int)]
    longest = max(len(t) for t in trajectories)
    slots = longest if model.memory is None else max(model.memory, 1)

    def window(name: str, begin: int, length: int):
        """Rows from `begin` after each moment on; zeros before the episode."""
        padded = (np.pad(getattr(t, name), ((slots, 0), (0, 0)))[s:] for t, s in starts)
        return np.stack([rows[slots + begin :][:length] for rows in padded])

    count = jnp.asarray([min(s, slots) for _, s in starts], jnp.int32)
    obs, action = window("obs", -slots, slots), window("action", -slots, slots)
    past = obs, action, window("obs", 1 - slots, slots)
    recent = RecentTransitions(*map(jnp.asarray, past), count=count)
    told, names = None, model.sim_param_names
    if names:
        told = jnp.asarray(np.stack([sim_params_row(t.sim_params, names) for t, _ in starts]))
    actions = jnp.asarray(window("action", 0, horizon))
    imagined = imagine(model, recent, actions, jax.random.split(key), told)
    std = np.concatenate([t.obs for t in trajectories]).std(0)
    scaled = (np.asarray(imagined) - window("obs", 1, horizon)) / np.where(std > 1e-6, std, np.inf)
    return np.sqrt(np.square(scaled).mean((0, 1, 3)))


@eqx.filter_jit
def imagine(
    model: Model,
    past: RecentTransitions,
    actions: Float[Array, "env horizon action"],
    keys: Keys,
    sim_params: Float[Array, "env sim_param"] | None = None,
) -> Float[Array, "member env horizon obs"]:
    """Mean prediction of every member along given actions, after living through the past."""
    belief = live_through(model, past, keys, sim_params)
    return follow(model.dynamics(belief), past.next_obs[:, -1], actions)


def predict_along(
    model: Model, trajectory: Trajectory, ahead: int, key: PRNGKeyArray
) -> tuple[Float[np.ndarray, "time ahead obs"], Int[np.ndarray, "time member"] | None]:
    """Predict from every step of an episode what its own actions lead to, without noise.

    Args:
        model: As the agent has it; it goes through the episode as the agent did.
        trajectory: The episode. Beyond its end its last action goes on.
        ahead: Imagined steps.
        key: Draws of a head selection that is random or sampled.

    Returns:
        The next observations, means over members, and the heads that predict them; None where a
        model has no heads.
    """
    names, steps = model.sim_param_names, np.arange(len(trajectory))
    told = jnp.asarray(sim_params_row(trajectory.sim_params, names))[None] if names else None
    past = np.maximum(steps - 1, 0)  # at the start it did not happen
    windows = trajectory.action[np.minimum(steps[:, None] + np.arange(ahead), steps[-1])]
    moments = steps, trajectory.obs[past], trajectory.action[past], trajectory.obs[:-1], windows

    def step(belief, moment):
        time, before, action, obs, actions = jax.tree.map(lambda x: x[None], moment)
        keys = jax.random.split(jax.random.fold_in(key, time[0]))
        belief = model.observe(belief, Transition(before, action, obs, time > 0), keys)
        imagined = follow(model.dynamics(belief), obs, actions)[:, 0].mean(0)
        return belief, (imagined, getattr(belief, "heads", [None])[0])

    found = jax.lax.scan(step, model.init_belief(1, told), jax.tree.map(jnp.asarray, moments))[1]
    return jax.tree.map(np.asarray, found)
