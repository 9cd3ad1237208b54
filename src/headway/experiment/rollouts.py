"""Acting in many environments at once and recording what happens.

One vector environment and one compiled agent serve collection and evaluation alike.
"""

import dataclasses
from collections.abc import Callable, Sequence
from typing import Any, Protocol

import jax
import jax.numpy as jnp
import numpy as np
from gymnasium.vector import AutoresetMode, VectorEnv
from jaxtyping import Float, Int, PRNGKeyArray

from headway import envs
from headway.config import Config
from headway.data import Trajectory
from headway.errors import BadEnvironmentError
from headway.planning.agent import Agent
from headway.planning.controller import env_action
from headway.sim_params import SimParamSets
from headway.tasks.base import Task
from headway.tasks.catalog import EnvSpec, env_spec


@dataclasses.dataclass(frozen=True)
class Episode:
    """What defines an episode before it is run: physics and seed."""

    sim_params: dict[str, float]
    seed: int


@dataclasses.dataclass(frozen=True)
class Arena:
    """Where a run acts: the facts of its environment, its Task, and the stepped batch."""

    spec: EnvSpec
    task: Task
    vector: VectorEnv
    sim_params: SimParamSets
    episode_length: int

    @classmethod
    def make(cls, config: Config) -> "Arena":
        """Build the batch of environments that a configuration asks for.

        Raises:
            BadEnvironmentError: The environment's spaces do not fit its Task.
        """
        spec = env_spec(config.env)
        options = {**spec.options, **config.env_options}
        task = spec.make_task(**options)
        length = config.collection.episode_length or spec.episode_length
        sim_params = config.sim_params or spec.sim_params
        vector = envs.make_vec(
            config.env,
            config.collection.num_episodes,
            sim_params=sim_params,
            options=options,
            autoreset_mode=AutoresetMode.DISABLED,
            episode_length=length,
        )
        got = (vector.single_observation_space.shape, vector.single_action_space.shape)
        allowed = ((task.obs_size,), (task.action_size,))
        if got != allowed:
            raise BadEnvironmentError(
                f"{config.env} has observation and action shapes {got}, allowed: {allowed}, as"
                f" its Task says; correct the environment or the Task."
            )
        return cls(spec, task, vector, sim_params, length)


class Policy(Protocol):
    """Chooses scaled actions for a batch of environments, step by step."""

    def __call__(
        self, obs: Float[np.ndarray, "env obs"]
    ) -> tuple[Float[np.ndarray, "env action"], Int[np.ndarray, " env"]]:
        """Return actions in [-1, 1], and how many planner iterations found nothing finite."""
        ...


def random_policy(arena: Arena, rng: np.random.Generator) -> Policy:
    """Uniform random actions, as in the first iteration."""
    shape = (arena.vector.num_envs, arena.task.action_size)
    no_failures = np.zeros(arena.vector.num_envs, int)
    return lambda obs: (rng.uniform(-1.0, 1.0, shape).astype(np.float32), no_failures)


class AgentPolicy:
    """An agent and what it remembers of each environment; it starts with an empty memory."""

    def __init__(self, agent: Agent, num_envs: int, *, key: PRNGKeyArray):
        self._agent = agent
        self.state = agent.init(num_envs, key=key)

    def __call__(
        self, obs: Float[np.ndarray, "env obs"]
    ) -> tuple[Float[np.ndarray, "env action"], Int[np.ndarray, " env"]]:
        """See `Policy`."""
        self.state, decision = self._agent.act(self.state, jnp.asarray(obs, jnp.float32))
        return jax.device_get((decision.action, decision.failures))


@dataclasses.dataclass(frozen=True)
class Rollout:
    """Finished episodes, in the order they were asked for."""

    trajectories: list[Trajectory]
    planner_failures: int


def run_episodes(
    arena: Arena,
    episodes: Sequence[Episode],
    policy: Policy,
    on_step: Callable[[int], None] = lambda steps: None,
) -> Rollout:
    """Run at most one episode in each environment of the batch, side by side.

    Args:
        arena: The environments; surplus ones repeat the last episode and are dropped.
        episodes: Physics and seeds, at most as many as there are environments.
        policy: Chooses the actions.
        on_step: Called after each step with the number of environments that stepped.

    Raises:
        BadEnvironmentError: An environment returned non-finite or misshapen values.
    """
    wanted = len(episodes)
    filled = [*episodes, *[episodes[-1]] * (arena.vector.num_envs - wanted)]
    names = filled[0].sim_params
    sim_params = {name: np.array([e.sim_params[name] for e in filled]) for name in names}
    seeds: Any = [episode.seed for episode in filled]
    obs, _ = arena.vector.reset(seed=seeds, options={"sim_params": sim_params})
    observations, actions, rewards = [check(arena, obs, filled, "obs", 0)], [], []
    length = np.zeros(len(filled), np.int64)
    terminated = np.zeros(len(filled), bool)
    running = np.ones(len(filled), bool)
    failures = 0
    for step in range(arena.episode_length):
        action, failed = policy(obs)
        failures += int(failed[:wanted][running[:wanted]].sum())
        obs, reward, ends, cut, _ = arena.vector.step(env_action(arena.task, action))
        observations.append(check(arena, obs, filled, "obs", step + 1))
        rewards.append(check(arena, reward, filled, "reward", step + 1))
        actions.append(action)
        length += running
        terminated |= running & ends
        running &= ~(ends | cut)
        on_step(wanted)
        if not running[:wanted].any():
            break
    table = np.stack(observations, 1), np.stack(actions, 1), np.stack(rewards, 1)
    trajectories = [
        _cut(table, row, int(length[row]), filled[row], bool(terminated[row]))
        for row in range(wanted)
    ]
    return Rollout(trajectories, failures)


def check(
    arena: Arena, values: np.ndarray, episodes: Sequence[Episode], what: str, step: int
) -> np.ndarray:
    """Refuse what no model should learn from.

    Raises:
        BadEnvironmentError: Values are misshapen or not finite; the message says where.
    """
    values = np.asarray(values)
    width = (arena.task.obs_size,) if what == "obs" else ()
    allowed = (arena.vector.num_envs, *width)
    if values.shape != allowed:
        raise BadEnvironmentError(
            f"{arena.spec.name} returned {what} of shape {values.shape} at step {step}, allowed:"
            f" {allowed}; correct the environment."
        )
    bad = ~np.isfinite(values.reshape(len(values), -1)).all(1)
    if bad.any():
        physics = episodes[int(np.argmax(bad))].sim_params
        raise BadEnvironmentError(
            f"{arena.spec.name} returned a non-finite {what} at step {step} under sim_params"
            f" {physics}, allowed: finite numbers; check the environment under these physics."
        )
    return values


def _cut(table, row: int, length: int, episode: Episode, terminated: bool) -> Trajectory:
    """One episode's part of what was recorded."""
    obs, action, reward = table
    return Trajectory(
        obs=obs[row, : length + 1].astype(np.float32),
        action=action[row, :length].astype(np.float32),
        reward=reward[row, :length].astype(np.float64),
        sim_params=episode.sim_params,
        terminated=terminated,
    )
