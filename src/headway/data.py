"""Trajectories, and the views of them that a model is fitted to."""

import dataclasses
from collections.abc import Mapping
from typing import Any, NamedTuple, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from headway.errors import BadEnvironmentError, ConfigError, shown
from headway.sim_params import is_finite

Tree = TypeVar("Tree")


@dataclasses.dataclass(frozen=True)
class Trajectory:
    """One episode under fixed physics.

    Actions are scaled to [-1, 1]. An episode of T transitions has T + 1 observations.
    """

    obs: Float[np.ndarray, "time_plus_1 obs"]
    """As the environment returned them, the last one included."""
    action: Float[np.ndarray, "time action"]
    """Actions that led from each observation to the next."""
    reward: Float[np.ndarray, " time"]
    """Reward that the environment paid for each action."""
    sim_params: Mapping[str, float]
    """The physics of the episode."""
    terminated: bool = False
    """The episode ended for good, and not because its time was up."""

    def __post_init__(self):
        steps = len(self.action)
        if steps < 1 or len(self.obs) != steps + 1 or len(self.reward) != steps:
            raise ConfigError(
                f"a trajectory has {len(self.obs)} observations, {steps} actions and"
                f" {len(self.reward)} rewards, allowed: T + 1, T and T with T at least 1."
            )
        for name in ("obs", "action", "reward"):
            bad = np.argwhere(~np.isfinite(getattr(self, name)))
            if len(bad):
                raise BadEnvironmentError(
                    f"{name} at step {bad[0][0]} is not finite, allowed: finite numbers; check the"
                    f" environment under sim_params {dict(self.sim_params)}."
                )

    @property
    def outcome(self) -> Float[np.ndarray, "time 2"]:
        """The reward of each transition, and whether it ended the episode for good."""
        last = np.arange(len(self)) == len(self) - 1
        return np.stack([self.reward, last & self.terminated], 1).astype(np.float32)

    @property
    def returns(self) -> float:
        """Undiscounted sum of rewards."""
        return float(np.sum(self.reward, dtype=np.float64))

    def __len__(self) -> int:
        return len(self.action)


def sim_params_row(
    sim_params: Mapping[str, float], names: tuple[str, ...]
) -> Float[np.ndarray, " sim_param"]:
    """Simulator parameters in a fixed order.

    Raises:
        ConfigError: A parameter has no value, or one that is no finite number.
    """
    missing = [name for name in names if not is_finite(sim_params.get(name))]
    if missing:
        raise ConfigError(
            f"sim_params {shown(dict(sim_params))} lack {', '.join(missing)}, allowed: a finite"
            f" number for each of {', '.join(names)}, which the model takes as input."
        )
    return np.array([sim_params[name] for name in names], np.float32)


class History(NamedTuple):
    """The last K transitions before a step, filled from the left, zeros on the right."""

    obs_diff: Float[Array, "*batch K obs"]
    action: Float[Array, "*batch K action"]


def history_slots(step: Any, length: int, xp: Any) -> tuple[Any, Any]:
    """Step that each slot of a history holds, and a mask of the slots that are used.

    Args:
        step: Steps whose past is wanted, with a trailing axis of 1.
        length: Number of slots (K).
        xp: `numpy` or `jax.numpy`.
    """
    index = xp.maximum(step - length, 0) + xp.arange(length)
    return index, index < step


def windows(
    values: Float[Array, "episode time size"],
    episode: Int[Array, "*batch"],
    start: Int[Array, "*batch"],
    length: int,
) -> Float[Array, "*batch length size"]:
    """Gather consecutive rows of episodes, as one piece of memory each.

    Args:
        values: One row per step.
        episode: The episode of each window.
        start: Its first step.
        length: Rows of a window.
    """
    size = values.shape[-1]

    def window(episode: Int[Array, ""], start: Int[Array, ""]) -> Float[Array, "length size"]:
        return jax.lax.dynamic_slice(values, (episode, start, 0), (1, length, size))[0]

    return jnp.vectorize(window, signature="(),()->(k,n)")(episode, start)


class Episodes(eqx.Module):
    """All trajectories as padded arrays on the device; rows past `count` are empty."""

    obs: Float[Array, "episode time_plus_1 obs"]
    action: Float[Array, "episode time action"]
    length: Int[Array, " episode"]
    count: Int[Array, ""]
    sim_params: Float[Array, "episode sim_param"]
    """The true simulator parameters that a model is told; of width 0 where it is told none."""
    outcome: Float[Array, "episode time outcome"]
    """Reward, and 1 where the episode ended for good; of width 0 where neither is learned."""

    @classmethod
    def pad(
        cls,
        trajectories: list[Trajectory],
        capacity: int,
        max_length: int,
        sim_param_names: tuple[str, ...] = (),
        *,
        outcomes: bool = False,
    ) -> "Episodes":
        """Lay trajectories out in arrays of fixed shape, repeating the last observation."""
        first = trajectories[0]
        obs = np.zeros((capacity, max_length + 1, first.obs.shape[1]), np.float32)
        action = np.zeros((capacity, max_length, first.action.shape[1]), np.float32)
        length = np.zeros(capacity, np.int32)
        sim_params = np.zeros((capacity, len(sim_param_names)), np.float32)
        outcome = np.zeros((capacity, max_length, 2 * outcomes), np.float32)
        for row, trajectory in enumerate(trajectories):
            steps = len(trajectory)
            sim_params[row] = sim_params_row(trajectory.sim_params, sim_param_names)
            obs[row, : steps + 1] = trajectory.obs
            obs[row, steps + 1 :] = trajectory.obs[-1]
            action[row, :steps] = trajectory.action
            if outcomes:
                outcome[row, :steps] = trajectory.outcome
            length[row] = steps
        count = jnp.asarray(len(trajectories), jnp.int32)
        return cls(*map(jnp.asarray, (obs, action, length, count, sim_params, outcome)))

    def history(
        self, episode: Int[Array, "*batch"], step: Int[Array, "*batch"], length: int
    ) -> History:
        """Gather what the context encoder sees at given steps.

        Slot j holds step j while fewer than K steps have passed, later a shifting window
        (released code). State differences are raw; the newest transition is included.

        Args:
            episode: Rows of the episodes.
            step: Steps whose past is wanted; transitions before them are used.
            length: Number of slots (K).
        """
        index, used = history_slots(step[..., None], length, jnp)
        there = min(length, self.action.shape[1])  # slots past a short episode are never used
        obs = windows(self.obs, episode, index[..., 0], there + 1)
        action = windows(self.action, episode, index[..., 0], there)

        def filled(values: Float[Array, "*batch slot size"]) -> Float[Array, "*batch K size"]:
            missing = [(0, 0)] * step.ndim + [(0, length - there), (0, 0)]
            return jnp.where(used[..., None], jnp.pad(values, missing), 0.0)

        return History(filled(jnp.diff(obs, axis=-2)), filled(action))


class Samples(NamedTuple):
    """Transitions that a model learns from: the context of `anchor` predicts `anchor + offset`."""

    episode: Int[Array, " sample"]
    anchor: Int[Array, " sample"]
    offset: Int[Array, " sample"]
    count: Int[Array, ""]

    @classmethod
    def table(
        cls, lengths: list[int], future_length: int, capacity: int, *, drop_first: bool = False
    ) -> "Samples":
        """List every valid (episode, anchor, offset), padded to `capacity` rows.

        Args:
            lengths: Transitions of each episode.
            future_length: Offsets 0 .. F-1 (F; released code).
            capacity: Rows of the table, at least as many as there are valid samples.
            drop_first: Leave out anchor 0 of each episode, as the released code does.
        """
        length = np.asarray(lengths)[:, None, None]
        anchor, offset = np.arange(length.max())[:, None], np.arange(future_length)
        valid = np.argwhere((anchor + offset < length) & (anchor >= int(drop_first)))
        table = np.zeros((3, capacity), np.int32)
        table[:, : len(valid)] = valid.T
        return cls(*map(jnp.asarray, table), count=jnp.asarray(len(valid), jnp.int32))


def where_env(condition: Bool[Array, " env"], chosen: Tree, other: Tree) -> Tree:
    """For each environment, the arrays of one tree or those of the other; environments lead."""
    return jax.tree.map(
        lambda x, y: jnp.where(condition.reshape(-1, *[1] * (x.ndim - 1)), x, y), chosen, other
    )


def segment_sums(
    values: Float[Array, "*batch time"], valid: Bool[Array, " time"], segment_length: int
) -> Float[Array, "*batch segment"]:
    """Sum valid values over consecutive segments; the last segment may be shorter."""
    steps = values.shape[-1]
    num_segments = -(-steps // segment_length)
    padding = [(0, 0)] * (values.ndim - 1) + [(0, num_segments * segment_length - steps)]
    kept = jnp.pad(jnp.where(valid, values, 0.0), padding)
    return kept.reshape(*values.shape[:-1], num_segments, segment_length).sum(-1)


def history_action_moments(
    trajectories: list[Trajectory], length: int
) -> tuple[Float[np.ndarray, "K action"], Float[np.ndarray, "K action"]]:
    """Mean and standard deviation of each history slot's actions, padding included.

    The zeros of an episode's first steps count, as in the released code.
    """
    total = squares = count = 0.0
    for trajectory in trajectories:
        index, used = history_slots(np.arange(len(trajectory))[:, None], length, np)
        clipped = np.minimum(index, len(trajectory) - 1)
        taken = trajectory.action[clipped].astype(np.float64)
        action = np.where(used[..., None], taken, 0.0)
        total = total + action.sum(0)
        squares = squares + (action**2).sum(0)
        count += len(trajectory)
    mean = np.asarray(total / count)
    return mean, np.sqrt(np.maximum(squares / count - mean**2, 0.0))
