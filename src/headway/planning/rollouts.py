"""Imagined rollouts: candidate action sequences in, returns out (released `core/utils.py`)."""

import functools
import itertools
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int, PRNGKeyArray

from headway.config import ModelConfig, PlannerConfig
from headway.models.base import Dynamics, over_rows
from headway.planning import cpu
from headway.task import Task


def candidate_returns(
    dynamics: Dynamics,
    task: Task,
    obs: Float[Array, "env obs"],
    candidates: Float[Array, "env candidate horizon action"],
    *,
    planner: PlannerConfig,
    key: PRNGKeyArray,
    shard: cpu.Shard | None = None,
) -> Float[Array, "shard_env shard_candidate"]:
    """Mean return of each candidate over its particles, each staying with one member (TS∞).

    A candidate of a single particle is imagined by one member of the ensemble, the next candidate
    by the next member (`within_members`).

    Every imagined step draws a fresh sample of the delta, or takes its mean. A particle whose
    episode has terminated earns nothing more. Nothing is clipped: a rollout that leaves the finite
    numbers gives a non-finite return, which ranks last. An environment's returns do not
    depend on the others: each has its own random stream.

    Args:
        dynamics: The model, specialised to its belief.
        task: Reward and termination, unless the dynamics has learned them.
        obs: Where each environment is now.
        candidates: Action sequences in [-1, 1].
        planner: Particles, their noise, and the reward that counts.
        key: Draws the noise of the rollouts.
        shard: The environments or candidates whose returns are wanted, if not all.
    """
    first_candidate = 0 if shard is None or shard.axis == 0 else shard.first
    keys = jax.vmap(functools.partial(jax.random.fold_in, key))(jnp.arange(len(obs)))
    args: tuple[Any, Array, Array, PRNGKeyArray] = (dynamics.own, obs, candidates, keys)
    if shard is not None:
        part = {"start_index": shard.first, "slice_size": shard.size}
        if shard.axis == 0:
            args = jax.tree.map(lambda x: jax.lax.dynamic_slice_in_dim(x, **part), args)
        else:
            own_candidates = jax.lax.dynamic_slice_in_dim(candidates, axis=1, **part)
            args = dynamics.own, obs, own_candidates, keys
    num_envs, num_candidates, horizon, _ = args[2].shape
    ensemble, obs_size = dynamics.num_members, obs.shape[-1]
    alone = planner.num_particles < ensemble  # each candidate has one member
    particles = 1 if alone else planner.num_particles // ensemble
    reward = task.released_reward if planner.reward == "released" else task.reward
    noisy = dynamics.stochastic and planner.particle_noise != "none"
    # On a CPU noise is drawn before a rollout: XLA would draw it again for every operation of a
    # step that uses it. Elsewhere that would take too much memory.
    in_steps = jax.default_backend() != "cpu"

    def drawn(key) -> Float[Array, "member obs particle candidate"]:
        """One step's noise. Each candidate has a stream of its own, whoever imagines it."""
        numbers = first_candidate + jnp.arange(num_candidates)
        keys = jax.vmap(functools.partial(jax.random.fold_in, key))(numbers)
        draw = functools.partial(jax.random.normal, shape=(ensemble, obs_size, particles))
        return jax.vmap(draw, out_axes=-1)(keys)

    def roll_out(some: Dynamics, obs, candidates, noise) -> Float[Array, "member particle cand"]:
        """The return of every rollout of some members of one environment."""
        draw = drawn if in_steps else None
        return rollout_returns(some, task, reward, obs, candidates, particles, (noise, draw))

    bytes_per_env = 4 * dynamics.widest * planner.num_particles * num_candidates
    budget = cpu.activation_budget() if shard is None else cpu.CACHES_OF_CORE
    # Where one environment is too much for the caches of a core, its members take turns.
    in_turns = shard is not None and ensemble > 1 and not alone and bytes_per_env > budget

    def of_env(own, obs, candidates, key) -> Float[Array, " candidate"]:
        one, noise = dynamics.of_env(own), None
        if noisy:
            keys = jax.random.split(key, horizon)
            noise = keys if in_steps else jax.vmap(drawn)(keys)
        if alone:
            each = -(-num_candidates // ensemble)
            # Each member's candidates, by their place in the shard; the last ones may be past it.
            place = (jnp.arange(ensemble)[:, None] - first_candidate) % ensemble
            place = place + ensemble * jnp.arange(each)
            returns = roll_out(one, obs, candidates.at[place].get(mode="clip"), noise)
            return jnp.zeros(num_candidates).at[place].set(returns[:, 0], mode="drop")
        if not in_turns:
            return roll_out(one, obs, candidates[None], noise).mean((0, 1))

        def of_member(member: Int[Array, ""]) -> Float[Array, "particle candidate"]:
            mine = noise if noise is None else noise[:, member][:, None]
            return roll_out(one.of_member(member), obs, candidates[None], mine)[0]

        return jax.lax.map(of_member, jnp.arange(ensemble)).mean((0, 1))

    at_once = cpu.environments_at_once(num_envs, bytes_per_env, budget)
    if at_once == num_envs:
        return jax.vmap(of_env)(*args)
    batch_size = at_once if at_once > 1 else None
    return jax.lax.map(lambda one: of_env(*one), args, batch_size=batch_size)


def rollout_returns(
    dynamics: Dynamics,
    task: Task,
    reward: Callable,
    obs: Float[Array, " obs"],
    candidates: Float[Array, "#member candidate horizon action"],
    particles: int,
    noise: tuple[Any, Callable | None],
) -> Float[Array, "member particle candidate"]:
    """Return of every rollout of one environment.

    Args:
        dynamics: Of that environment, of all members or one.
        task: Termination, and the units of actions.
        reward: The reward that counts.
        obs: Where the environment is now.
        candidates: Action sequences in [-1, 1], shared by the members or each one's own.
        particles: Rollouts of a candidate with each member.
        noise: Normal draws of every step, [horizon, member, obs, particle, #candidate], or None to
            predict means; and what turns a step's part into the draws, if they are not drawn yet.
    """
    rows, (by_step, draw) = (dynamics.num_members, particles, candidates.shape[1]), noise
    pays, ends, scale = map(over_rows, (reward, task.terminated, task.scale_action))

    def wide(values: Float[Array, "*member size"]) -> Float[Array, "member size particle cand"]:
        return jnp.broadcast_to(values[..., None, None], (rows[0], values.shape[-1], *rows[1:]))

    def imagine(carry, step):
        state, obs, alive, paid = carry
        action, noise = step
        action = jnp.broadcast_to(action[:, :, None], (rows[0], action.shape[1], *rows[1:]))
        state, next_obs = dynamics.step(state, obs, action, draw(noise) if draw else noise)
        action = scale(action)
        learned = dynamics.outcome(state)
        now, over = learned or (pays(obs, action, next_obs), jnp.zeros(rows, bool))
        paid = paid + jnp.where(alive, now, 0.0)
        alive = alive & ~(over | ends(obs, action, next_obs))
        return (state, next_obs, alive, paid), None

    begin = jax.tree.map(wide, dynamics.start()), wide(obs), jnp.ones(rows, bool), jnp.zeros(rows)
    (*_, paid), _ = jax.lax.scan(imagine, begin, (candidates.transpose(2, 0, 3, 1), by_step))
    return paid


def within_members(
    returns: Float[Array, "env candidate"], planner: PlannerConfig, num_members: int
) -> Float[Array, "env candidate"]:
    """Returns that can be compared, whichever members imagined the candidates.

    Candidate i with a single particle is imagined by member i modulo their number. A member that
    promises more than the others would then choose the plan; so every return counts from the mean
    of its member's, and all of them from the mean of all.

    Args:
        returns: Of all candidates.
        planner: Its number of particles.
        num_members: Members of the ensemble.
    """
    if planner.num_particles >= num_members:
        return returns
    mine = jnp.arange(returns.shape[1]) % num_members == jnp.arange(num_members)[:, None]
    counted = mine[:, None] & jnp.isfinite(returns)
    means = jnp.mean(jnp.broadcast_to(returns, counted.shape), -1, where=counted)
    level = jnp.nanmean(means, 0)[:, None]
    return returns - jnp.einsum("mc,me->ec", mine, jnp.nan_to_num(means)) + level


def follow(
    dynamics: Dynamics, obs: Float[Array, "env obs"], actions: Float[Array, "env horizon action"]
) -> Float[Array, "member env horizon obs"]:
    """Observations along given actions, without noise; a rollout per member and environment.

    Args:
        dynamics: The model, specialised to its belief.
        obs: Where each environment is now.
        actions: In [-1, 1].
    """

    def of_env(own, obs, actions) -> Float[Array, "horizon member obs"]:
        one = dynamics.of_env(own)

        def alone(values: Float[Array, " size"]) -> Float[Array, "member size 1 1"]:
            return jnp.broadcast_to(values[:, None, None], (one.num_members, values.size, 1, 1))

        def step(carry, action):
            state, obs = carry
            state, obs = one.step(state, obs, alone(action), None)
            return (state, obs), obs[..., 0, 0]

        state = jax.tree.map(lambda x: x[..., None, None], one.start())
        return jax.lax.scan(step, (state, alone(obs)), actions)[1]

    return jax.vmap(of_env)(dynamics.own, obs, actions).transpose(2, 0, 1, 3)


def plan_flop(model: ModelConfig, planner: PlannerConfig, task: Task, evaluations: float) -> float:
    """Floating-point operations of the matrix products of one environment's plan.

    The imagined rollouts are counted. Left out is what happens once per step, encoding the
    context, learning and choosing a head: less than a thousandth at the paper's sizes.

    Args:
        model: Settings of the networks.
        planner: Settings of the planner.
        task: The sizes of observations and actions.
        evaluations: Candidates that were scored.
    """
    if not model.learns:
        return 0.0
    # Averaged mean heads are folded into one; their variances are not.
    variances = model.num_heads if planner.head_selection == "average" else 1
    outputs = 1 + (0 if model.deterministic else variances)
    sizes = (task.feature_size + task.action_size, *model.hidden_sizes)
    recurrent = model.kind == "recurrent"  # four gates per unit
    products = sum(4 * (n + m) * m if recurrent else n * m for n, m in itertools.pairwise(sizes))
    numbers = outputs * task.obs_size + 2 * model.learned_reward
    per_step = 2.0 * (products + sizes[-1] * numbers)
    particles = model.num_members if planner.optimizer.name == "ilqr" else planner.num_particles
    return evaluations * particles * planner.horizon * per_step
