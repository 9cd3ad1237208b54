"""Imagined observations against real ones."""

from collections.abc import Sequence

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, PRNGKeyArray

from headway.data import Trajectory, sim_params_row
from headway.models.base import Keys, Model, RecentTransitions, Transition
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
        key: Draws heads where nothing was observed, and samples of a sampled selection.
    """
    starts = [(t, s) for t in trajectories for s in range(first, len(t) - horizon + 1)]
    if not starts:
        return np.zeros(0)
    starts = [starts[i] for i in np.linspace(0, len(starts) - 1, NUM_STARTS, dtype=int)]
    imagined = np.asarray(imagine_from(model, starts, horizon, key)[0])
    real = np.stack([t.obs[s + 1 : s + 1 + horizon] for t, s in starts])
    std = np.concatenate([t.obs for t in trajectories]).std(0)
    scaled = (imagined - real) / np.where(std > 1e-6, std, np.inf)
    return np.sqrt(np.square(scaled).mean((0, 1, 3)))


def imagine_from(
    model: Model, starts: Sequence[tuple[Trajectory, int]], horizon: int, key: PRNGKeyArray
) -> tuple[Float[Array, "member start horizon obs"], Int[Array, "start member"] | None]:
    """Imagine what an episode's own actions lead to, as `imagine`, from some moments on.

    Args:
        model: It has lived through what went before.
        starts: Episodes and steps, with `horizon` actions from there on.
        horizon: Imagined steps.
        key: Draws heads where nothing was observed, and samples of a sampled selection.
    """
    slots = max(len(t) for t, _ in starts) if model.memory is None else max(model.memory, 1)

    def window(name: str, begin: int, length: int):
        """Rows from `begin` after each moment on; zeros before the episode."""
        padded = (np.pad(getattr(t, name), ((slots, 0), (0, 0)))[s:] for t, s in starts)
        return np.stack([rows[slots + begin :][:length] for rows in padded])

    count = jnp.asarray([min(s, slots) for _, s in starts], jnp.int32)
    obs, action = window("obs", -slots, slots), window("action", -slots, slots)
    past = obs, action, window("obs", 1 - slots, slots)
    recent = RecentTransitions(*map(jnp.asarray, past), count=count)
    rows = np.stack([sim_params_row(t.sim_params, model.sim_param_names) for t, _ in starts])
    told = jnp.asarray(rows) if model.sim_param_names else None
    actions = jnp.asarray(window("action", 0, horizon))
    return imagine(model, recent, actions, jax.random.split(key), told)


@eqx.filter_jit
def imagine(
    model: Model,
    past: RecentTransitions,
    actions: Float[Array, "env horizon action"],
    keys: Keys,
    sim_params: Float[Array, "env sim_param"] | None = None,
) -> tuple[Float[Array, "member env horizon obs"], Int[Array, "env member"] | None]:
    """Mean prediction of every member along given actions, after living through the past.

    And the head of every member; None where a model has none.
    """
    num_envs, slots, _ = past.obs.shape

    def observe(belief, slot):
        index, obs, action, next_obs = slot
        seen = Transition(obs, action, next_obs, index >= slots - past.count)
        return model.observe(belief, seen, keys), None

    by_slot = (jnp.moveaxis(x, 1, 0) for x in past[:3])
    first = model.init_belief(num_envs, sim_params)
    belief, _ = jax.lax.scan(observe, first, (jnp.arange(slots), *by_slot))
    imagined = follow(model.dynamics(belief), past.next_obs[:, -1], actions)
    return imagined, getattr(belief, "heads", None)
