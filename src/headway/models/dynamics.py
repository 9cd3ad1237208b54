"""The multi-headed, context-conditional dynamics model (supplement A.3; fact sheet B.1)."""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PRNGKeyArray

from headway.config import ModelConfig
from headway.data import History, Trajectory, history_action_moments, parts_of
from headway.models.moments import Moments, merge_columns
from headway.models.networks import Dense, DenseHeads, Normalizer, bound_logvar, swish
from headway.tasks.base import Task

PART_TRANSITIONS = 2**17  # read at once for statistics; the paper's whole data are one part


class Prediction(NamedTuple):
    """Gaussian over the normalised `delta`; `logvar` is None in deterministic mode."""

    mean: Float[Array, "*batch obs"]
    logvar: Float[Array, "*batch obs"] | None


class GaussianNet(eqx.Module):
    """Backbone and prediction heads of every member; the context joins after the backbone."""

    hidden: tuple[Dense, ...]
    mean_heads: DenseHeads
    logvar_heads: DenseHeads | None
    max_logvar: Float[Array, "head obs"] | None
    min_logvar: Float[Array, "head obs"] | None

    @classmethod
    def init(
        cls, config: ModelConfig, in_size: int, out_size: int, *, key: PRNGKeyArray
    ) -> "GaussianNet":
        """Draw the weights of one network per member."""
        members, heads = config.num_members, config.num_heads
        *hidden_keys, mean_key, logvar_key = jax.random.split(key, len(config.hidden_sizes) + 2)
        sizes = (in_size, *config.hidden_sizes)
        hidden = tuple(
            Dense.init(members, n, m, key=k)
            for n, m, k in zip(sizes[:-1], sizes[1:], hidden_keys, strict=True)
        )
        head_size = sizes[-1] + config.context_size
        mean_heads = DenseHeads.init(members, heads, head_size, out_size, key=mean_key)
        if config.deterministic:
            return cls(hidden, mean_heads, None, None, None)
        logvar_heads = DenseHeads.init(members, heads, head_size, out_size, key=logvar_key)
        shape = (heads, out_size)
        bounds = jnp.full(shape, 0.5, jnp.float32), jnp.full(shape, -10.0, jnp.float32)
        return cls(hidden, mean_heads, logvar_heads, *bounds)

    def backbone(self, x: Float[Array, "member batch in"]) -> Float[Array, "member batch hidden"]:
        """Run the shared hidden layers."""
        for layer in self.hidden:
            x = swish(layer(x))
        return x

    def __call__(
        self,
        x: Float[Array, "member batch in"],
        context: Float[Array, "member batch context"] | None,
    ) -> Prediction:
        """Predict with every head; results are [member, head, batch, obs]."""
        x = self.backbone(x)
        if context is not None:
            x = jnp.concatenate([x, context], axis=-1)
        if self.logvar_heads is None:
            return Prediction(self.mean_heads(x), None)
        low, high = self.min_logvar[:, None, :], self.max_logvar[:, None, :]
        return Prediction(self.mean_heads(x), bound_logvar(self.logvar_heads(x), low, high))


class ContextEncoder(eqx.Module):
    """Turns the last K transitions into a context vector, once per member."""

    hidden: tuple[Dense, ...]
    output: Dense

    @classmethod
    def init(cls, config: ModelConfig, in_size: int, *, key: PRNGKeyArray) -> "ContextEncoder":
        """Draw the weights of one encoder per member."""
        sizes = (in_size, *config.context_hidden_sizes, config.context_size)
        keys = jax.random.split(key, len(sizes) - 1)
        *hidden, output = (
            Dense.init(config.num_members, n, m, key=k)
            for n, m, k in zip(sizes[:-1], sizes[1:], keys, strict=True)
        )
        return cls(tuple(hidden), output)

    def __call__(self, x: Float[Array, "member batch in"]) -> Float[Array, "member batch context"]:
        """Encode flattened histories."""
        for layer in self.hidden:
            x = jax.nn.relu(layer(x))
        return self.output(x)


class Statistics(eqx.Module):
    """Normalisers of everything that enters or leaves the networks; refitted, not learned."""

    features: Normalizer
    action: Normalizer
    delta: Normalizer
    backward_delta: Normalizer
    history_action: Normalizer

    @classmethod
    def identity(cls, task: Task, history_length: int) -> "Statistics":
        """Statistics before any data: nothing is scaled."""
        return cls(
            Normalizer.identity(task.feature_size),
            Normalizer.identity(task.action_size),
            Normalizer.identity(task.obs_size),
            Normalizer.identity(task.obs_size),
            Normalizer.identity(history_length, task.action_size),
        )

    @classmethod
    def fit(cls, task: Task, trajectories: list[Trajectory], history_length: int) -> "Statistics":
        """Recompute from all data so far, as at the start of every iteration (B.3).

        The data are read once, in parts of `PART_TRANSITIONS`, and never held together.
        """
        parts = parts_of(trajectories, PART_TRANSITIONS)
        found = merge_columns(transition_moments(task, part) for part in parts)
        features, action, delta, backward = (Normalizer.of_moments(m.mean, m.std) for m in found)
        history = history_action_moments(trajectories, history_length)
        return cls(features, action, delta, backward, Normalizer.of_moments(*history))


def transition_moments(
    task: Task, trajectories: list[Trajectory]
) -> tuple[Moments, Moments, Moments, Moments]:
    """Moments of the features, actions, targets and backward targets of some transitions."""
    obs = jnp.asarray(np.concatenate([t.obs[:-1] for t in trajectories]))
    next_obs = jnp.asarray(np.concatenate([t.obs[1:] for t in trajectories]))
    return (
        Moments.of(np.asarray(task.preprocess(obs))),
        Moments.of(np.concatenate([t.action for t in trajectories])),
        Moments.of(np.asarray(task.target(obs, next_obs))),
        Moments.of(np.asarray(task.target(next_obs, obs))),
    )


class MultiHeadDynamics(eqx.Module):
    """An ensemble of multi-headed networks, with optional context encoder and backward net."""

    forward_net: GaussianNet
    backward_net: GaussianNet | None
    context_encoder: ContextEncoder | None

    @classmethod
    def init(cls, config: ModelConfig, task: Task, *, key: PRNGKeyArray) -> "MultiHeadDynamics":
        """Draw initial weights for a task's sizes."""
        forward_key, backward_key, context_key = jax.random.split(key, 3)
        in_size = task.feature_size + task.action_size
        history_size = config.history_length * (task.obs_size + task.action_size)
        return cls(
            GaussianNet.init(config, in_size, task.obs_size, key=forward_key),
            GaussianNet.init(config, in_size, task.obs_size, key=backward_key)
            if config.backward_net
            else None,
            ContextEncoder.init(config, history_size, key=context_key)
            if config.context_size
            else None,
        )

    @property
    def num_members(self) -> int:
        """Networks in the ensemble."""
        return self.forward_net.mean_heads.weight.shape[0]

    @property
    def num_heads(self) -> int:
        """Prediction heads of each network."""
        return self.forward_net.mean_heads.weight.shape[1]

    def context(
        self, history: History, statistics: Statistics
    ) -> Float[Array, "member batch context"] | None:
        """Encode histories; state differences are not normalised (fact sheet B.3).

        Args:
            history: Past transitions, [member, batch, K, ...].
            statistics: The normalisers in use.
        """
        if self.context_encoder is None:
            return None
        members, batch = history.action.shape[:2]
        action = statistics.history_action.normalize(history.action)
        flat = [history.obs_diff.reshape(members, batch, -1), action.reshape(members, batch, -1)]
        return self.context_encoder(jnp.concatenate(flat, axis=-1))


def network_input(
    task: Task,
    statistics: Statistics,
    obs: Float[Array, "*batch obs"],
    action: Float[Array, "*batch action"],
) -> Float[Array, "*batch in"]:
    """What enters a backbone: normalised features, then the normalised action."""
    features = statistics.features.normalize(task.preprocess(obs))
    return jnp.concatenate([features, statistics.action.normalize(action)], axis=-1)
