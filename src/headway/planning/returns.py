"""Imagined rollouts: candidate action sequences in, returns out (released `core/utils.py`)."""

import dataclasses
import functools
from typing import Any, Protocol, runtime_checkable

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PRNGKeyArray

from headway.config import PlannerConfig
from headway.planning.devices import Devices, environments_at_once, spread_candidates
from headway.planning.imagination import over_rows
from headway.planning.noise import normal
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
    devices: Devices = "local"
    """Which devices share the candidates."""

    @classmethod
    def of(cls, planner: PlannerConfig, num_members: int) -> "RolloutSettings":
        """Read them from the planner's settings."""
        return cls(
            planner.num_particles // num_members,
            planner.particle_noise == "shared",
            planner.reward == "released",
            planner.risk_aversion,
            planner.devices,
        )


@runtime_checkable
class Dynamics(Protocol):
    """What one plan imagines with; arrays are [member, feature, particle, candidate]."""

    @property
    def num_members(self) -> int:
        """Models that imagine side by side."""
        ...

    @property
    def stochastic(self) -> bool:
        """Whether `step` uses noise."""
        ...

    @property
    def widest(self) -> int:
        """Numbers in the widest layer of one step; decides how much is imagined at once."""
        ...

    @property
    def per_env(self) -> Any:
        """The arrays that differ between environments; these lead."""
        ...

    def of_env(self, part: Any) -> "Dynamics":
        """The dynamics of one environment, whose arrays have no such axis."""
        ...

    def start(self) -> Any:
        """What one environment's rollouts carry from step to step; arrays [member, size]."""
        ...

    def step(
        self,
        task: Task,
        carry: Any,
        obs: Float[Array, "member obs particle candidate"],
        action: Float[Array, "member action particle candidate"],
        noise: Float[Array, "member obs particle #candidate"] | None,
    ) -> tuple[Any, Float[Array, "member obs particle candidate"]]:
        """One imagined step of one environment.

        Args:
            task: How observations enter and leave a model.
            carry: From the last step.
            obs: Where each rollout is.
            action: What it does, in [-1, 1].
            noise: Standard normal draws; None predicts the mean.

        Returns:
            What to carry on, and the next observations.
        """
        ...


def candidate_returns(
    dynamics: Dynamics,
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

    def of_one(part, obs, candidates, key):
        one = dynamics.of_env(part)
        return _environment_returns(one, task, obs, candidates, settings=settings, key=key)

    rows = num_candidates * settings.particles_per_member * dynamics.num_members
    at_once = environments_at_once(num_envs, 4 * dynamics.widest * rows)
    args: tuple[Any, Array, Array, PRNGKeyArray] = (dynamics.per_env, obs, candidates, keys)
    if at_once == num_envs:
        return jax.vmap(of_one)(*args)
    batch_size = at_once if at_once > 1 else None
    return jax.lax.map(lambda one: of_one(*one), args, batch_size=batch_size)


def follow(
    dynamics: Dynamics,
    task: Task,
    obs: Float[Array, "env obs"],
    actions: Float[Array, "env horizon action"],
) -> Float[Array, "member env horizon obs"]:
    """Where given actions lead, without noise; one rollout per member and environment.

    Args:
        dynamics: The model, as a plan would imagine with it.
        task: How observations enter and leave the model.
        obs: Where each environment is now.
        actions: What is done, in [-1, 1].
    """
    members = dynamics.num_members

    def alone(values: Float[Array, " size"]) -> Float[Array, "member size 1 1"]:
        return jnp.broadcast_to(values[:, None, None], (members, values.size, 1, 1))

    def of_one(part, obs, actions) -> Float[Array, "horizon member obs"]:
        one = dynamics.of_env(part)

        def step(carry, action):
            memory, obs = carry
            memory, obs = one.step(task, memory, obs, alone(action), None)
            return (memory, obs), obs[..., 0, 0]

        memory = jax.tree.map(lambda x: x[..., None, None], one.start())
        return jax.lax.scan(step, (memory, alone(obs)), actions)[1]

    return jax.vmap(of_one)(dynamics.per_env, obs, actions).transpose(2, 0, 1, 3)


def _environment_returns(
    dynamics: Dynamics,
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
    spread = functools.partial(spread_candidates, devices=settings.devices)

    # On CPUs XLA would draw noise again for every operation of a step that uses it, so it is
    # drawn before the rollout. Elsewhere that would take too much memory.
    independent = dynamics.stochastic and not settings.shared_noise
    step_by_step = independent and jax.default_backend() != "cpu"

    def imagine(carry, step):
        obs, alive, total, memory = carry
        scaled, noise = step
        scaled = spread(jnp.broadcast_to(scaled[:, None], (members, action_size, *rows[1:])))
        noise = draw(noise) if step_by_step else noise
        memory, next_obs = dynamics.step(task, memory, obs, scaled, noise)
        action = scale_action(scaled)
        total = total + jnp.where(alive, reward_of(obs, action, next_obs), 0.0)
        alive = alive & ~terminated(obs, action, next_obs)
        return (next_obs, alive, total, memory), None

    def draw(key):
        return spread(normal(key, (members, obs.shape[0], particles, num_candidates)))

    def noise_of_steps():
        if not dynamics.stochastic:
            return None
        if settings.shared_noise:
            shape = horizon, members, obs.shape[0], particles
            return jax.random.normal(key, shape)[..., None]
        keys = jax.random.split(key, horizon)
        return keys if step_by_step else jax.vmap(draw)(keys)

    def wide(values):
        return spread(
            jnp.broadcast_to(values[..., None, None], (members, values.shape[-1], *rows[1:]))
        )

    memory = jax.tree.map(wide, dynamics.start())
    carry = wide(obs), jnp.ones(rows, bool), jnp.zeros(rows), memory
    steps = candidates.transpose(1, 2, 0), noise_of_steps()
    (_, _, total, _), _ = jax.lax.scan(imagine, carry, steps)
    if not settings.risk_aversion:
        return total.mean((0, 1))
    return total.mean((0, 1)) - settings.risk_aversion * total.std((0, 1))
