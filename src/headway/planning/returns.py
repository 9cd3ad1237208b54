"""Imagined rollouts: candidate action sequences in, returns out (released `core/utils.py`)."""

import dataclasses
import functools
from typing import Any, NamedTuple, Protocol, runtime_checkable

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int, PRNGKeyArray

from headway.config import PlannerConfig
from headway.planning.devices import SHARE_BUDGET, environments_at_once, spread_candidates
from headway.planning.imagination import over_rows
from headway.planning.noise import normal_block
from headway.task import Task


@dataclasses.dataclass(frozen=True)
class RolloutSettings:
    """What fixes a compiled rollout, apart from the shapes."""

    particles_per_member: int
    shared_noise: bool = False
    """Whether all candidates of a step share the noise of their particles."""
    released_reward: bool = False
    """Whether to plan with the released code's reward."""

    @classmethod
    def of(cls, planner: PlannerConfig, num_members: int) -> "RolloutSettings":
        """Read them from the planner's settings."""
        return cls(
            planner.num_particles // num_members,
            planner.particle_noise == "shared",
            planner.reward == "released",
        )


@runtime_checkable
class Dynamics(Protocol):
    """What one plan imagines with: a pytree, since it goes from one program to the next.

    Arrays are [member, feature, particle, candidate].
    """

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


@runtime_checkable
class Ensemble(Dynamics, Protocol):
    """A `Dynamics` of several members that can also be imagined one by one."""

    def of_member(self, member: Int[Array, ""]) -> "Dynamics":
        """The dynamics of one member, whose arrays keep that axis; called after `of_env`."""
        ...


class Share(NamedTuple):
    """Which of all candidates are imagined here, by a program that has one core for itself."""

    first: Int[Array, ""]
    total: int
    """How many candidates there are; noise is drawn for each as it is with all of them."""


def candidate_returns(
    dynamics: Dynamics,
    task: Task,
    obs: Float[Array, "env obs"],
    candidates: Float[Array, "env candidate horizon action"],
    *,
    settings: RolloutSettings,
    key: PRNGKeyArray,
    share: Share | None = None,
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
        share: Which candidates these are, if they are not all.
    """
    num_envs, num_candidates = candidates.shape[:2]
    keys = jax.vmap(functools.partial(jax.random.fold_in, key))(jnp.arange(num_envs))
    rows = num_candidates * settings.particles_per_member * dynamics.num_members
    bytes_per_env = 4 * dynamics.widest * rows
    budget = None if share is None else SHARE_BUDGET
    at_once = environments_at_once(num_envs, bytes_per_env, budget)
    one_by_one = budget is not None and bytes_per_env > budget

    def of_one(part, obs, candidates, key):
        one = dynamics.of_env(part)
        rollouts = _Rollouts(one, task, obs, candidates, settings, key, share)
        return rollouts.returns(one_by_one=one_by_one)

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


class _Rollouts(NamedTuple):
    """All that the rollouts of one environment are made of; layout as in `imagination`."""

    dynamics: Dynamics
    task: Task
    obs: Float[Array, " obs"]
    candidates: Float[Array, "candidate horizon action"]
    settings: RolloutSettings
    key: PRNGKeyArray
    share: Share | None

    def returns(self, *, one_by_one: bool) -> Float[Array, " candidate"]:
        """`candidate_returns` of this environment.

        Args:
            one_by_one: Whether members that can be are imagined one after the other, so that
                what one of them computes stays in the caches. The noise is the same.
        """
        dynamics = self.dynamics
        if one_by_one and dynamics.num_members > 1 and isinstance(dynamics, Ensemble):
            members = jnp.arange(dynamics.num_members)
            total = jax.lax.map(lambda i: self._totals(dynamics.of_member(i), i)[0], members)
        else:
            total = self._totals(dynamics, jnp.zeros((), jnp.int32))
        return total.mean((0, 1))

    def _totals(
        self, dynamics: Dynamics, member: Int[Array, ""]
    ) -> Float[Array, "member particle candidate"]:
        """The return of every rollout of some members, from one of them on."""
        num_candidates, _, action_size = self.candidates.shape
        members, particles = dynamics.num_members, self.settings.particles_per_member
        rows = members, particles, num_candidates
        task, spread = self.task, spread_candidates
        reward_of = task.released_reward if self.settings.released_reward else task.reward
        reward_of, terminated = over_rows(reward_of), over_rows(task.terminated)
        scale_action = over_rows(task.scale_action)

        def imagine(carry, step):
            obs, alive, total, memory = carry
            scaled, noise = step
            scaled = spread(jnp.broadcast_to(scaled[:, None], (members, action_size, *rows[1:])))
            noise = self._drawn(noise, members, member)
            memory, next_obs = dynamics.step(task, memory, obs, scaled, noise)
            action = scale_action(scaled)
            total = total + jnp.where(alive, reward_of(obs, action, next_obs), 0.0)
            alive = alive & ~terminated(obs, action, next_obs)
            return (next_obs, alive, total, memory), None

        def wide(values):
            shape = members, values.shape[-1], *rows[1:]
            return spread(jnp.broadcast_to(values[..., None, None], shape))

        memory = jax.tree.map(wide, dynamics.start())
        carry = wide(self.obs), jnp.ones(rows, bool), jnp.zeros(rows), memory
        steps = self.candidates.transpose(1, 2, 0), self._noise_of_steps(members, member)
        (_, _, total, _), _ = jax.lax.scan(imagine, carry, steps)
        return total

    def _noise_of_steps(self, members: int, member: Int[Array, ""]) -> Array | None:
        """The noise of all steps, or keys to draw it with.

        On a CPU it is drawn before the rollout, because XLA draws it several times over wherever
        several operations of a step use it. Elsewhere that would take too much memory.
        """
        if not self.dynamics.stochastic:
            return None
        horizon, particles = self.candidates.shape[1], self.settings.particles_per_member
        if self.settings.shared_noise:
            shape = horizon, self.dynamics.num_members, self.obs.shape[0], particles
            shared = jax.random.normal(self.key, shape)[..., None]
            return jax.lax.dynamic_slice_in_dim(shared, member, members, axis=1)
        keys = jax.random.split(self.key, horizon)
        if jax.default_backend() != "cpu":
            return keys
        return jax.vmap(lambda key: self._draw(key, members, member))(keys)

    def _drawn(
        self, step: Array | None, members: int, member: Int[Array, ""]
    ) -> Float[Array, "member obs particle #candidate"] | None:
        """The noise of one step, drawn now if it is not yet."""
        if step is None or jnp.issubdtype(step.dtype, jnp.floating):
            return step
        return self._draw(step, members, member)

    def _draw(
        self, key: PRNGKeyArray, members: int, member: Int[Array, ""]
    ) -> Float[Array, "member obs particle candidate"]:
        """One step's noise of some members and candidates, as it is with all of them."""
        here, obs_size = len(self.candidates), self.obs.shape[0]
        first, total = self.share or (0, here)
        particles = self.settings.particles_per_member
        whole = self.dynamics.num_members, obs_size, particles, total
        start, size = (member, 0, 0, first), (members, obs_size, particles, here)
        return spread_candidates(normal_block(key, whole, start, size))
