"""Imagined rollouts: candidate action sequences in, returns out (released `core/utils.py`)."""

import functools
import itertools
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int, PRNGKeyArray

from headway.config import ModelConfig, PlannerConfig
from headway.models.base import Dynamics, over_rows
from headway.planning import cpu
from headway.planning.optimizers import make_optimizer
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
) -> Float[Array, "env shard"]:
    """Mean return of each candidate over its particles, each staying with one member (TS∞).

    Every imagined step draws a fresh sample of the delta. A particle whose episode has
    terminated earns nothing more. Nothing is clipped: a rollout that leaves the finite
    numbers gives a non-finite return, which ranks last. An environment's returns do not
    depend on the others: each has its own random stream.

    Args:
        dynamics: The model, specialised to its belief.
        task: Reward and termination.
        obs: Where each environment is now.
        candidates: Action sequences in [-1, 1].
        planner: Particles, their noise, and the reward that counts.
        key: Draws the noise of the rollouts.
        shard: The candidates whose returns are wanted, if not all.
    """
    total, first_candidate = candidates.shape[1], 0
    if shard is not None:
        first_candidate, size = shard
        candidates = jax.lax.dynamic_slice_in_dim(candidates, first_candidate, size, axis=1)
    num_envs, num_candidates, horizon, action_size = candidates.shape
    ensemble, obs_size = dynamics.num_members, obs.shape[-1]
    particles = planner.num_particles // ensemble
    reward = over_rows(task.released_reward if planner.reward == "released" else task.reward)
    terminated, scale_action = over_rows(task.terminated), over_rows(task.scale_action)
    shared = planner.particle_noise == "shared"
    # On a CPU noise is drawn before a rollout: XLA would draw it again for every operation of a
    # step that uses it. Elsewhere that would take too much memory.
    in_steps = dynamics.stochastic and not shared and jax.default_backend() != "cpu"

    def roll_out(
        some: Dynamics, first: Int[Array, ""], obs, candidates, key
    ) -> Float[Array, "member particle candidate"]:
        """The return of every rollout of some members of one environment, from `first` on."""
        rows = some.num_members, particles, num_candidates

        def wide(values: Float[Array, "*member size"]) -> Float[Array, "member size particle cand"]:
            return jnp.broadcast_to(values[..., None, None], (rows[0], values.shape[-1], *rows[1:]))

        def draw(key) -> Float[Array, "member obs particle candidate"]:
            """One step's noise: the block of these members and candidates of the noise of all."""
            whole = ensemble, obs_size, particles, total
            start, size = (first, 0, 0, first_candidate), (rows[0], obs_size, *rows[1:])
            return cpu.normal_block(key, whole, start, size)

        def imagine(carry, step):
            state, obs, alive, paid = carry
            action, noise = step
            action = jnp.broadcast_to(action[:, None], (rows[0], action_size, *rows[1:]))
            state, next_obs = some.step(state, obs, action, draw(noise) if in_steps else noise)
            action = scale_action(action)
            paid = paid + jnp.where(alive, reward(obs, action, next_obs), 0.0)
            alive = alive & ~terminated(obs, action, next_obs)
            return (state, next_obs, alive, paid), None

        noise = None
        if dynamics.stochastic and shared:
            of_all = jax.random.normal(key, (horizon, ensemble, obs_size, particles))[..., None]
            noise = jax.lax.dynamic_slice_in_dim(of_all, first, rows[0], axis=1)
        elif dynamics.stochastic:
            keys = jax.random.split(key, horizon)
            noise = keys if in_steps else jax.vmap(draw)(keys)
        state = jax.tree.map(wide, some.start())
        begin = state, wide(obs), jnp.ones(rows, bool), jnp.zeros(rows)
        (*_, paid), _ = jax.lax.scan(imagine, begin, (candidates.transpose(1, 2, 0), noise))
        return paid

    bytes_per_env = 4 * dynamics.widest * ensemble * particles * num_candidates
    budget = cpu.activation_budget() if shard is None else cpu.CACHES_OF_CORE
    # Where one environment is too much for the caches of a core, its members take turns.
    in_turns = shard is not None and ensemble > 1 and bytes_per_env > budget

    def of_env(own, obs, candidates, key) -> Float[Array, " candidate"]:
        one = dynamics.of_env(own)
        if not in_turns:
            return roll_out(one, jnp.zeros((), jnp.int32), obs, candidates, key).mean((0, 1))

        def of_member(member: Int[Array, ""]) -> Float[Array, "particle candidate"]:
            return roll_out(one.of_member(member), member, obs, candidates, key)[0]

        return jax.lax.map(of_member, jnp.arange(ensemble)).mean((0, 1))

    keys = jax.vmap(functools.partial(jax.random.fold_in, key))(jnp.arange(num_envs))
    args: tuple[Any, Array, Array, PRNGKeyArray] = (dynamics.own, obs, candidates, keys)
    at_once = cpu.environments_at_once(num_envs, bytes_per_env, budget)
    if at_once == num_envs:
        return jax.vmap(of_env)(*args)
    batch_size = at_once if at_once > 1 else None
    return jax.lax.map(lambda one: of_env(*one), args, batch_size=batch_size)


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


def plan_flop(
    model: ModelConfig, planner: PlannerConfig, task: Task, evaluations: float | None = None
) -> float:
    """Floating-point operations of the matrix products of one environment's plan.

    The imagined rollouts are counted. Left out is what happens once per step, encoding the
    context, learning and choosing a head: less than a thousandth at the paper's sizes.

    Args:
        model: Settings of the networks.
        planner: Settings of the planner.
        task: The sizes of observations and actions.
        evaluations: Candidates that were scored; by default as many as the search may score.
    """
    if not model.learns:
        return 0.0
    # Averaged mean heads are folded into one; their variances are not.
    variances = model.num_heads if planner.head_selection == "average" else 1
    outputs = 1 + (0 if model.deterministic else variances)
    sizes = (task.feature_size + task.action_size, *model.hidden_sizes)
    recurrent = model.kind == "recurrent"  # four gates per unit
    products = sum(4 * (n + m) * m if recurrent else n * m for n, m in itertools.pairwise(sizes))
    per_step = 2.0 * (products + sizes[-1] * outputs * task.obs_size)
    if evaluations is None:
        evaluations = make_optimizer(planner).max_evaluations
    return evaluations * planner.num_particles * planner.horizon * per_step
