"""The iterative linear-quadratic regulator (iLQR): plans with feedback, for unstable machines."""

import functools
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from headway.data import where_env
from headway.errors import ConfigError
from headway.models.base import Dynamics
from headway.task import Task


class Policy(NamedTuple):
    """A plan that answers deviations: action = nominal + gain · (obs - expected), within ±1."""

    nominal: Float[Array, "env horizon action"]
    expected: Float[Array, "env horizon obs"]
    gain: Float[Array, "env horizon action obs"]
    non_finite: Int[Array, " env"]
    """Iterations without any finite return; they change nothing else."""
    evaluations: Int[Array, " env"]
    """Plans that were imagined; a slope by one number costs as much as one."""

    def answer(self, obs: Float[Array, "env obs"]) -> Float[Array, "env action"]:
        """The action of the first step, also where the environment is not where it should be."""
        away = obs - self.expected[:, 0]
        return jnp.clip(self.nominal[:, 0] + jnp.einsum("eao,eo->ea", self.gain[:, 0], away), -1, 1)


class ILQR(eqx.Module):
    """Plans by a linear model of the dynamics and a quadratic one of the reward, around a plan.

    Where a small deviation grows quickly, hardly one of many sequences of actions stays near what
    it began with. So what is planned here is the answer to deviations too (Li and Todorov, 2004).
    An iteration follows the last policy from where the environment is, by the mean prediction of
    all members, and solves for the best change of actions and gains. Plans between the old and
    the new one compete, each imagined with its feedback.
    """

    num_candidates: int
    num_iterations: int
    action_cost: float

    def init(self, num_envs: int, horizon: int, action_size: int, obs_size: int) -> Policy:
        """Actions of zero without feedback."""
        none = jnp.zeros(num_envs, jnp.int32)
        gain = jnp.zeros((num_envs, horizon, action_size, obs_size))
        return Policy(gain[..., 0], gain[..., 0, :], gain, none, none)

    def shift(self, policy: Policy) -> Policy:
        """The policy one step later; its last step is repeated."""
        later = (jnp.concatenate([x[:, 1:], x[:, -1:]], axis=1) for x in policy[:3])
        return Policy(*later, *(jnp.zeros_like(count) for count in policy[3:]))

    def iterate(
        self, dynamics: Dynamics, task: Task, obs: Float[Array, "env obs"], policy: Policy
    ) -> Policy:
        """The policy of every environment after another iteration."""
        each = jax.vmap(lambda own, *given: self.improve(dynamics.of_env(own), task, *given))
        nominal, expected, gain, paid = each(dynamics.own, obs, *policy[:3])
        tried = 3 + self.num_candidates + sum(policy.gain.shape[2:])  # once more for each slope
        policy = policy._replace(evaluations=policy.evaluations + tried)
        found = policy._replace(nominal=nominal, expected=expected, gain=gain)
        failed = policy._replace(non_finite=policy.non_finite + 1)
        return where_env(jnp.isfinite(paid), found, failed)

    def improve(
        self,
        dynamics: Dynamics,
        task: Task,
        obs: Float[Array, " obs"],
        nominal: Float[Array, "horizon action"],
        expected: Float[Array, "horizon obs"],
        gain: Float[Array, "horizon action obs"],
    ) -> tuple[Array, Array, Array, Float[Array, ""]]:
        """The next policy of one environment, and the return that it promises."""
        if jax.tree.leaves(dynamics.start()):
            raise ConfigError(
                "planner.optimizer.name is 'ilqr', allowed with this model, which carries a state"
                " or learns the reward: another search."
            )

        def step(obs, action):
            members = jnp.ones((dynamics.num_members, 1, 1, 1))
            obs, action = (members * x[:, None, None] for x in (obs, action))
            return dynamics.step(dynamics.start(), obs, action, None)[1][..., 0, 0].mean(0)

        def reward(alive, obs, action, next_obs):
            effort = self.action_cost * jnp.square(action).sum()
            return alive * task.reward(obs, task.scale_action(action), next_obs) - effort

        def follow(nominal, expected, gain):
            def imagine(carry, now):
                (obs, alive, paid), (nominal, expected, gain) = carry, now
                action = jnp.clip(nominal + gain @ (obs - expected), -1.0, 1.0)
                after = jnp.where(alive, step(obs, action), obs)
                paid = paid + reward(alive, obs, action, after)
                over = task.terminated(obs, task.scale_action(action), after)
                return (after, alive & ~over, paid), (alive, obs, action)

            start = obs, jnp.array(True), jnp.zeros(())
            (*_, paid), way = jax.lax.scan(imagine, start, (nominal, expected, gain))
            return paid, *way

        _, visited, actions = way = follow(nominal, expected, gain)[1:]
        change, gain = best_change(*jax.vmap(functools.partial(expand, step, reward))(*way))
        shares = jnp.linspace(1.0, 0.0, self.num_candidates + 1) ** 3  # mostly small, and none
        tried = jax.vmap(lambda share: follow(actions + share * change, visited, gain))
        paid, _, ways, plans = tried(shares)
        best = jnp.argmax(jnp.where(jnp.isfinite(paid), paid, -jnp.inf))
        return plans[best], ways[best], gain, paid[best]


def expand(
    step: Any, reward: Any, alive: Array, obs: Array, action: Array
) -> tuple[Float[Array, "obs both"], Float[Array, " both"], Float[Array, "both both"]]:
    """Slopes of a step, slope and curvature of its reward, by observation and action together.

    The curvature is that of the reward of the linear step, without what is above zero; there a
    little is left, so that there is one best change.
    """
    both, size = jnp.concatenate([obs, action]), obs.size
    slopes = jax.jacfwd(lambda both: step(both[:size], both[size:]))(both)
    slopes = jnp.where(alive, slopes, jnp.eye(size, both.size))  # nothing moves after the end

    def earned(change):
        moved = both + change
        return reward(alive, moved[:size], moved[size:], step(obs, action) + slopes @ change)

    still = jnp.zeros_like(both)
    values, vectors = jnp.linalg.eigh(jax.hessian(earned)(still))
    return slopes, jax.grad(earned)(still), (vectors * jnp.minimum(values, -1e-6)) @ vectors.T


def best_change(
    slopes: Float[Array, "horizon obs both"],
    slope: Float[Array, "horizon both"],
    curvature: Float[Array, "horizon both both"],
) -> tuple[Float[Array, "horizon action"], Float[Array, "horizon action obs"]]:
    """The change of the actions that earns most, and the gains, from the last step to the first."""
    size = slopes.shape[1]

    def back(value, now):
        (value_slope, value_curvature), (slopes, slope, curvature) = value, now
        slope = slope + slopes.T @ value_slope
        curvature = curvature + slopes.T @ value_curvature @ slopes
        cross, own = curvature[size:, :size], curvature[size:, size:]
        change, gain = -jnp.linalg.solve(own, slope[size:]), -jnp.linalg.solve(own, cross)
        value_curvature = curvature[:size, :size] + cross.T @ gain
        value = slope[:size] + cross.T @ change, (value_curvature + value_curvature.T) / 2
        return value, (change, gain)

    last = jnp.zeros(size), jnp.zeros((size, size))
    return jax.lax.scan(back, last, (slopes, slope, curvature), reverse=True)[1]
