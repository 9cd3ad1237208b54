"""Imagined rollouts: candidate action sequences in, returns out (fact sheet C.2)."""

import dataclasses
import functools
from collections.abc import Callable

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PRNGKeyArray

from headway.config import PlannerConfig
from headway.planning.devices import environments_at_once, spread_candidates
from headway.planning.imagination import ChosenHeads, ImaginedDynamics
from headway.tasks.base import Task


@dataclasses.dataclass(frozen=True)
class RolloutSettings:
    """What fixes a compiled rollout, apart from the shapes."""

    particles_per_member: int
    shared_noise: bool = False
    """Whether all candidates of a step share the noise of their particles."""
    released_reward: bool = False
    """Whether to plan with the released code's reward."""
    risk_aversion: float = 0.0
    """Standard deviations over the particles that are taken off the mean return."""

    @classmethod
    def of(cls, planner: PlannerConfig, num_members: int) -> "RolloutSettings":
        """Read them from the planner's settings."""
        return cls(
            planner.num_particles // num_members,
            planner.particle_noise == "shared",
            planner.reward == "released",
            planner.risk_aversion,
        )


def candidate_returns(
    dynamics: ImaginedDynamics,
    task: Task,
    obs: Float[Array, "env obs"],
    candidates: Float[Array, "env candidate horizon action"],
    *,
    settings: RolloutSettings,
    key: PRNGKeyArray,
) -> Float[Array, "env candidate"]:
    """Mean return of each candidate over its particles, each staying with one member (TS∞).

    Every imagined step draws a fresh sample of the delta. A particle whose episode has
    terminated earns nothing more. Nothing is clipped: a rollout that leaves the finite
    numbers gives a non-finite return, which ranks last. An environment's result does not
    depend on the others: each has its own random stream.

    Args:
        dynamics: The model, folded for this plan.
        task: Reward, termination, preprocessing.
        obs: Where each environment is now.
        candidates: Action sequences in [-1, 1].
        settings: What else fixes the rollouts.
        key: Draws the noise of the rollouts.
    """
    num_envs, num_candidates = candidates.shape[:2]
    keys = jax.vmap(functools.partial(jax.random.fold_in, key))(jnp.arange(num_envs))

    def of_one(heads, obs, candidates, key):
        one = dynamics.with_heads(heads)
        return _environment_returns(one, task, obs, candidates, settings=settings, key=key)

    widest = max(layer.bias.shape[-1] for layer in dynamics.hidden)
    rows = num_candidates * settings.particles_per_member * dynamics.num_members
    at_once = environments_at_once(num_envs, 4 * widest * rows)
    args: tuple[ChosenHeads, Array, Array, PRNGKeyArray] = (dynamics.heads, obs, candidates, keys)
    if at_once == num_envs:
        return jax.vmap(of_one)(*args)
    batch_size = at_once if at_once > 1 else None
    return jax.lax.map(lambda one: of_one(*one), args, batch_size=batch_size)


def _environment_returns(
    dynamics: ImaginedDynamics,
    task: Task,
    obs: Float[Array, " obs"],
    candidates: Float[Array, "candidate horizon action"],
    *,
    settings: RolloutSettings,
    key: PRNGKeyArray,
) -> Float[Array, " candidate"]:
    """`candidate_returns` of one environment; layout as in `imagination`."""
    num_candidates, horizon, action_size = candidates.shape
    members, particles = dynamics.num_members, settings.particles_per_member
    rows = members, particles, num_candidates
    reward_of = task.released_reward if settings.released_reward else task.reward
    reward_of, terminated = over_rows(reward_of), over_rows(task.terminated)
    scale_action = over_rows(task.scale_action)

    def imagine(carry, step):
        obs, alive, total = carry
        scaled, noise = step
        scaled = spread_candidates(
            jnp.broadcast_to(scaled[:, None], (members, action_size, *rows[1:]))
        )
        next_obs = imagine_step(dynamics, task, obs, scaled, draw(noise, obs.shape))
        action = scale_action(scaled)
        total = total + jnp.where(alive, reward_of(obs, action, next_obs), 0.0)
        alive = alive & ~terminated(obs, action, next_obs)
        return (next_obs, alive, total), None

    def draw(noise, shape):
        if not dynamics.stochastic:
            return None
        if settings.shared_noise:
            return noise[..., None]
        return spread_candidates(jax.random.normal(noise, shape))

    if settings.shared_noise and dynamics.stochastic:
        noise = jax.random.normal(key, (horizon, members, obs.shape[0], particles))
    else:
        noise = jax.random.split(key, horizon)
    start = jnp.broadcast_to(obs[:, None, None], (members, obs.shape[0], *rows[1:]))
    carry = spread_candidates(start), jnp.ones(rows, bool), jnp.zeros(rows)
    (_, _, total), _ = jax.lax.scan(imagine, carry, (candidates.transpose(1, 2, 0), noise))
    if not settings.risk_aversion:
        return total.mean((0, 1))
    return total.mean((0, 1)) - settings.risk_aversion * total.std((0, 1))


def imagine_step(
    dynamics: ImaginedDynamics,
    task: Task,
    obs: Float[Array, "member obs particle candidate"],
    action: Float[Array, "member action particle candidate"],
    noise: Float[Array, "member obs particle #candidate"] | None,
) -> Float[Array, "member obs particle candidate"]:
    """One imagined step of one environment.

    Args:
        dynamics: The model, folded, with one environment's heads.
        task: How observations enter and leave the model.
        obs: Where each rollout is.
        action: What it does, in [-1, 1].
        noise: Standard normal draws; None predicts the mean.
    """
    x = jnp.concatenate([over_rows(task.preprocess)(obs), action], axis=1)
    return over_rows(task.postprocess)(obs, dynamics.sample_delta(x, noise))


def over_rows(function: Callable) -> Callable:
    """Let a Task's method, which wants features last, take [member, feature, *rows]."""
    return jax.vmap(jax.vmap(function, in_axes=-1, out_axes=-1), in_axes=-1, out_axes=-1)
