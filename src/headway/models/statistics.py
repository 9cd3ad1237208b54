"""Normalisers of all that enters or leaves a network, and its input in their units."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from headway.data import History, Trajectory, history_action_moments, sim_params_row
from headway.task import Task


class Normalizer(eqx.Module):
    """Shifts and scales features to zero mean and unit variance (released `tmcl.py`).

    A feature that never varied has `std` 0: it is shifted but not scaled, and
    `denormalize` gives back its mean whatever the network says.
    """

    mean: Float[Array, "*size"]
    std: Float[Array, "*size"]

    @classmethod
    def identity(cls, *size: int) -> "Normalizer":
        """A normaliser that changes nothing."""
        return cls(jnp.zeros(size), jnp.ones(size))

    @classmethod
    def fit(cls, values: Float[np.ndarray, "count size"]) -> "Normalizer":
        """Take mean and standard deviation of values, in float64."""
        values = np.asarray(values, np.float64)
        return cls.of_moments(values.mean(0), values.std(0))

    @classmethod
    def of_moments(cls, mean: np.ndarray, std: np.ndarray) -> "Normalizer":
        """Build from moments computed in float64; what float32 can't resolve is constant."""
        constant = std <= 1e-5 * np.maximum(np.abs(mean), 1e-12)
        return cls(
            jnp.asarray(mean, jnp.float32), jnp.asarray(np.where(constant, 0, std), jnp.float32)
        )

    @property
    def scale(self) -> Float[Array, "*size"]:
        """Divisor of `normalize`: the standard deviation, or 1 where it is 0."""
        return jnp.where(self.std > 0, self.std + 1e-10, 1.0)

    def normalize(self, values: Float[Array, "*batch size"]) -> Float[Array, "*batch size"]:
        """Scale values to zero mean and unit variance."""
        return (values - self.mean) / self.scale

    def denormalize(self, values: Float[Array, "*batch size"]) -> Float[Array, "*batch size"]:
        """Undo `normalize`."""
        return values * self.std + self.mean


class Statistics(eqx.Module):
    """Normalisers of everything that enters or leaves the networks; refitted, not learned."""

    features: Normalizer
    action: Normalizer
    delta: Normalizer
    backward_delta: Normalizer
    history_action: Normalizer
    sim_params: Normalizer | None = None
    """Only for a model that takes the true simulator parameters."""
    reward: Normalizer | None = None
    """Only for a model that learns the reward."""

    @classmethod
    def identity(
        cls,
        task: Task,
        history_length: int,
        sim_param_names: tuple[str, ...] = (),
        *,
        learned_reward: bool = False,
    ) -> "Statistics":
        """Statistics before any data: nothing is scaled."""
        return cls(
            Normalizer.identity(task.feature_size),
            Normalizer.identity(task.action_size),
            Normalizer.identity(task.obs_size),
            Normalizer.identity(task.obs_size),
            Normalizer.identity(history_length, task.action_size),
            Normalizer.identity(len(sim_param_names)) if sim_param_names else None,
            Normalizer.identity(1) if learned_reward else None,
        )

    @classmethod
    def fit(
        cls,
        task: Task,
        trajectories: list[Trajectory],
        history_length: int,
        sim_param_names: tuple[str, ...] = (),
        *,
        learned_reward: bool = False,
    ) -> "Statistics":
        """Recompute from all data so far, as at the start of every iteration.

        A simulator parameter that never varied is shifted to 0 and not scaled.

        Args:
            task: How observations enter and leave the model.
            trajectories: All data.
            history_length: Past transitions that a context is made of (K).
            sim_param_names: Simulator parameters that the model is told.
            learned_reward: The model learns the reward.
        """
        obs = jnp.asarray(np.concatenate([t.obs[:-1] for t in trajectories]))
        next_obs = jnp.asarray(np.concatenate([t.obs[1:] for t in trajectories]))
        told = None
        if sim_param_names:
            rows = np.stack([sim_params_row(t.sim_params, sim_param_names) for t in trajectories])
            told = Normalizer.fit(np.repeat(rows, [len(t) for t in trajectories], axis=0))
        return cls(
            Normalizer.fit(np.asarray(task.preprocess(obs))),
            Normalizer.fit(np.concatenate([t.action for t in trajectories])),
            Normalizer.fit(np.asarray(task.target(obs, next_obs))),
            Normalizer.fit(np.asarray(task.target(next_obs, obs))),
            Normalizer.of_moments(*history_action_moments(trajectories, history_length)),
            told,
            Normalizer.fit(np.concatenate([t.outcome for t in trajectories])[:, :1])
            if learned_reward
            else None,
        )


def flat_history(
    history: History, statistics: Statistics
) -> Float[Array, "member batch K_times_obs_and_action"]:
    """Input of a context encoder; state differences are not normalised (released code)."""
    members, batch = history.action.shape[:2]
    action = statistics.history_action.normalize(history.action)
    flat = [history.obs_diff.reshape(members, batch, -1), action.reshape(members, batch, -1)]
    return jnp.concatenate(flat, axis=-1)


def network_input(
    task: Task,
    statistics: Statistics,
    obs: Float[Array, "*batch obs"],
    action: Float[Array, "*batch action"],
) -> Float[Array, "*batch in"]:
    """Input of a backbone: normalised features, then the normalised action."""
    features = statistics.features.normalize(task.preprocess(obs))
    return jnp.concatenate([features, statistics.action.normalize(action)], axis=-1)
