"""Imagined rollouts: candidate action sequences in, returns out (fact sheet C.2).

Inside a plan the layout is [member, env, row, feature], a row being one particle of one
candidate: members lead because their weights differ, and everything else becomes one
matrix product per member.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int, PRNGKeyArray

from headway.models.dynamics import MultiHeadDynamics, Statistics
from headway.models.networks import Dense, bound_logvar, swish
from headway.tasks.base import Task


class ImaginedDynamics(eqx.Module):
    """A dynamics model with all that is fixed during one plan folded into its weights.

    Only the chosen heads remain, one set per environment and member; the context has become
    part of their biases; normalisation has gone into the first layer and de-normalisation
    into the heads. With several chosen heads the sampled delta is the average of their
    samples (non-adaptive planning), drawn in one go.
    """

    hidden: tuple[Dense, ...]
    mean_weight: Float[Array, "member env hidden obs"]
    mean_bias: Float[Array, "member env obs"]
    logvar_weight: Float[Array, "member env choice hidden obs"] | None
    logvar_bias: Float[Array, "member env choice obs"] | None
    min_logvar: Float[Array, "member env choice obs"] | None
    max_logvar: Float[Array, "member env choice obs"] | None
    delta_std: Float[Array, " obs"]

    @classmethod
    def fold(
        cls,
        model: MultiHeadDynamics,
        statistics: Statistics,
        heads: Int[Array, "env member choice"],
        context: Float[Array, "member env context"] | None,
    ) -> "ImaginedDynamics":
        """Fold a model for one plan.

        Args:
            model: The dynamics model.
            statistics: The normalisers in use.
            heads: The chosen heads; one per environment and member, or all of them.
            context: The context vector of each member and environment.
        """
        net = model.forward_net
        choice = heads.transpose(1, 0, 2)
        hidden_size = net.hidden[-1].bias.shape[-1]

        def chosen(layer):
            weight, bias = _take_heads(layer.weight, choice), _take_heads(layer.bias, choice)
            if context is not None:
                bias = bias + jnp.einsum("mec,mekco->meko", context, weight[..., hidden_size:, :])
            return weight[..., :hidden_size, :], bias

        delta = statistics.delta
        mean_weight, mean_bias = chosen(net.mean_heads)
        logvar_weight = logvar_bias = low = high = None
        if net.logvar_heads is not None:
            logvar_weight, logvar_bias = chosen(net.logvar_heads)
            low, high = net.min_logvar[choice], net.max_logvar[choice]
        return cls(
            (_fold_input(net.hidden[0], statistics), *net.hidden[1:]),
            mean_weight.mean(2) * delta.std,
            mean_bias.mean(2) * delta.std + delta.mean,
            logvar_weight,
            logvar_bias,
            low,
            high,
            delta.std,
        )

    def sample_delta(
        self, x: Float[Array, "member env row in"], noise: Float[Array, "member env row obs"] | None
    ) -> Float[Array, "member env row obs"]:
        """Draw the next delta in raw units; its mean where `noise` is None."""
        members, num_envs, rows, _ = x.shape
        x = x.reshape(members, num_envs * rows, -1)
        for layer in self.hidden:
            x = swish(layer(x))
        x = x.reshape(members, num_envs, rows, -1)
        mean = x @ self.mean_weight + self.mean_bias[:, :, None]
        if noise is None or self.logvar_weight is None:
            return mean
        logvar = x[:, :, None] @ self.logvar_weight + self.logvar_bias[..., None, :]
        low, high = self.min_logvar[..., None, :], self.max_logvar[..., None, :]
        var = jnp.exp(bound_logvar(logvar, low, high))
        std = jnp.sqrt(var.sum(2)) / var.shape[2]
        return mean + noise * std * self.delta_std


def candidate_returns(
    dynamics: ImaginedDynamics,
    task: Task,
    obs: Float[Array, "env obs"],
    candidates: Float[Array, "env candidate horizon action"],
    *,
    particles_per_member: int,
    released_reward: bool = False,
    key: PRNGKeyArray,
) -> Float[Array, "env candidate"]:
    """Mean return of each candidate over its particles, each staying with one member (TS∞).

    Every imagined step draws a fresh sample of the delta. A particle whose episode has
    terminated earns nothing more. Nothing is clipped: a rollout that leaves the finite
    numbers gives a non-finite return, which ranks last.

    Args:
        dynamics: The model, folded for this plan.
        task: Reward, termination, preprocessing.
        obs: Where each environment is now.
        candidates: Action sequences in [-1, 1].
        particles_per_member: Imagined rollouts per candidate and member.
        released_reward: Plan with the released code's reward.
        key: Draws the noise of the rollouts.
    """
    members = dynamics.mean_bias.shape[0]
    num_envs, num_candidates, horizon, _ = candidates.shape
    rows = num_candidates * particles_per_member
    reward_of = task.released_reward if released_reward else task.reward
    stochastic = dynamics.logvar_weight is not None

    def imagine(carry, step):
        obs, alive, total = carry
        scaled, key = step
        scaled = jnp.repeat(scaled, particles_per_member, axis=1)
        scaled = jnp.broadcast_to(scaled, (members, *scaled.shape))
        x = jnp.concatenate([task.preprocess(obs), scaled], axis=-1)
        noise = jax.random.normal(key, obs.shape) if stochastic else None
        next_obs = task.postprocess(obs, dynamics.sample_delta(x, noise))
        action = task.scale_action(scaled)
        total = total + jnp.where(alive, reward_of(obs, action, next_obs), 0.0)
        alive = alive & ~task.terminated(obs, action, next_obs)
        return (next_obs, alive, total), None

    start = jnp.broadcast_to(obs[None, :, None], (members, num_envs, rows, obs.shape[-1]))
    carry = start, jnp.ones(start.shape[:-1], bool), jnp.zeros(start.shape[:-1])
    steps = candidates.transpose(2, 0, 1, 3), jax.random.split(key, horizon)
    (_, _, total), _ = jax.lax.scan(imagine, carry, steps)
    particles = total.reshape(members, num_envs, num_candidates, particles_per_member)
    return particles.mean((0, 3))


def _take_heads(
    values: Float[Array, "member head *rest"], choice: Int[Array, "member env choice"]
) -> Float[Array, "member env choice *rest"]:
    return values[jnp.arange(values.shape[0])[:, None, None], choice]


def _fold_input(layer: Dense, statistics: Statistics) -> Dense:
    """Let the first layer take raw features and actions."""
    scale = jnp.concatenate([statistics.features.scale, statistics.action.scale])
    mean = jnp.concatenate([statistics.features.mean, statistics.action.mean])
    weight = layer.weight / scale[:, None]
    return Dense(weight, layer.bias - jnp.einsum("i,mio->mo", mean, weight))
