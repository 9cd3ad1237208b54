"""Acting in many environments at once and recording what happens.

One vector environment and one compiled agent serve collection and evaluation alike.
"""

import dataclasses
import time
from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING, Any, NamedTuple, Protocol

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, Int, PRNGKeyArray

from headway.config import Config
from headway.data import Trajectory
from headway.errors import BadEnvironmentError
from headway.experiment.bad_episodes import Watch
from headway.planning.acting import Acting
from headway.planning.controller import env_action
from headway.sim_params import SimParamSets
from headway.task import EnvSpec, Task, env_options, env_spec, episode_length, sim_param_sets

if TYPE_CHECKING:
    from gymnasium.vector import VectorEnv


@dataclasses.dataclass(frozen=True)
class Episode:
    """What defines an episode before it is run: physics and seed."""

    sim_params: dict[str, float]
    seed: int
    schedule: Mapping[int, dict[str, float]] = dataclasses.field(default_factory=dict)
    """Physics that change during the episode, by the step before which they do."""


@dataclasses.dataclass(frozen=True)
class Arena:
    """Where a run acts: the facts of its environment, its Task, and the stepped batch."""

    spec: EnvSpec
    task: Task
    vector: "VectorEnv"
    sim_params: SimParamSets
    episode_length: int

    @classmethod
    def make(cls, config: Config) -> "Arena":
        """Build the batch of environments that a configuration asks for.

        Raises:
            BadEnvironmentError: The environment's spaces do not fit its Task.
        """
        from gymnasium.vector import AutoresetMode  # a controller is loaded without a simulator

        from headway import envs

        spec, collection = env_spec(config.env), config.collection
        options = env_options(config)
        task = spec.make_task(**options)
        length = episode_length(config)
        sim_params = sim_param_sets(config)
        vector = envs.make_vec(
            config.env,
            collection.num_episodes,
            sim_params=sim_params,
            options=options,
            autoreset_mode=AutoresetMode.DISABLED,
            episode_length=length,
            step_timeout_s=collection.step_timeout_s if collection.env_processes else None,
        )
        got = (vector.single_observation_space.shape, vector.single_action_space.shape)
        allowed = ((task.obs_size,), (task.action_size,))
        if got != allowed:
            vector.close()
            raise BadEnvironmentError(
                f"{config.env} has observation and action shapes {got}, allowed: {allowed}, as"
                f" its Task says; correct the environment or the Task."
            )
        return cls(spec, task, vector, sim_params, length)

    def close(self) -> None:
        """Free what the environments hold, and end their processes."""
        self.vector.close()


class Choice(NamedTuple):
    """What a policy chose for every environment of a batch."""

    action: Float[np.ndarray, "env action"]
    """The actions to take, in [-1, 1]."""
    failures: Int[np.ndarray, " env"]
    """Planner iterations that found nothing finite."""
    evaluations: Int[np.ndarray, " env"]
    """Candidates that the planner scored."""
    timed: bool = True
    """Whether choosing took as long as planning takes; not where an earlier choice is repeated."""


class Policy(Protocol):
    """Chooses scaled actions for a batch of environments, step by step."""

    def __call__(self, obs: Float[np.ndarray, "env obs"]) -> Choice:
        """Choose for every environment."""
        ...


def random_policy(arena: Arena, rng: np.random.Generator) -> Policy:
    """Uniform random actions, as in the first iteration."""
    shape = (arena.vector.num_envs, arena.task.action_size)
    none = np.zeros(arena.vector.num_envs, int)
    return lambda obs: Choice(rng.uniform(-1.0, 1.0, shape).astype(np.float32), none, none)


class AgentPolicy:
    """An agent and what it remembers of each environment; it starts with an empty memory.

    Args:
        agent: The agent.
        num_envs: Environments of the batch.
        episodes: What they run, for an agent that is told the physics; surplus environments
            repeat the last episode.
        key: The planner's draws.
    """

    def __init__(
        self, agent: Acting, num_envs: int, episodes: Sequence[Episode], *, key: PRNGKeyArray
    ):
        self._agent = agent
        physics = [episode.sim_params for episode in fill(episodes, num_envs)]
        self.state = agent.init(num_envs, key=key, sim_params=physics)

    def __call__(self, obs: Float[np.ndarray, "env obs"]) -> Choice:
        """See `Policy`."""
        self.state, decision = self._agent.act(self.state, jnp.asarray(obs, jnp.float32))
        return Choice(*jax.device_get((decision.action, decision.failures, decision.evaluations)))


@dataclasses.dataclass(frozen=True)
class PlannerUse:
    """What planning took over some episodes; sums with `+`."""

    steps: int = 0
    """Environment steps that were planned."""
    failures: int = 0
    """Planner iterations that found nothing finite."""
    evaluations: int = 0
    """Candidates that were scored."""
    timed_steps: int = 0
    """Environment steps that were timed, those of surplus environments included."""
    seconds: float = 0.0
    """What the timed steps took."""

    @classmethod
    def of_step(cls, choice: Choice, running: Bool[np.ndarray, " env"]) -> "PlannerUse":
        """One step, in which only the first `len(running)` environments matter."""
        failures, evaluations = (int(x[: len(running)][running].sum()) for x in choice[1:3])
        return cls(int(running.sum()), failures, evaluations)

    def __add__(self, other: "PlannerUse") -> "PlannerUse":
        mine, others = dataclasses.astuple(self), dataclasses.astuple(other)
        return PlannerUse(*(a + b for a, b in zip(mine, others, strict=True)))


@dataclasses.dataclass(frozen=True)
class Rollout:
    """Finished episodes, in the order they were asked for, without the broken ones."""

    trajectories: list[Trajectory]
    use: PlannerUse
    broken: Mapping[int, str] = dataclasses.field(default_factory=dict)
    """What was wrong with each episode that is left out, by its number among those asked for."""

    @property
    def numbers(self) -> list[int]:
        """The number of each trajectory's episode among those asked for."""
        asked = range(len(self.trajectories) + len(self.broken))
        return [number for number in asked if number not in self.broken]


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

    An episode that breaks (`HeadwayVectorEnv`), or with a number that is not finite, ends there
    and is left out; the other environments go on.

    Raises:
        BadEnvironmentError: The environment raised, or returned something misshapen.
    """
    wanted = len(episodes)
    filled = fill(episodes, arena.vector.num_envs)
    names = filled[0].sim_params
    sim_params = {name: np.array([e.sim_params[name] for e in filled]) for name in names}
    seeds: Any = [episode.seed for episode in filled]
    options: dict[str, Any] = {"sim_params": sim_params}
    if any(episode.schedule for episode in filled):
        options["schedule"] = [episode.schedule for episode in filled]
    watch = Watch(arena.spec.name, [episode.sim_params for episode in filled])
    with watch.raising("reset"):
        obs, info = arena.vector.reset(seed=seeds, options=options)
    watch.note(info, 0)
    obs = watch.finite(obs, "obs", 0, np.zeros((len(filled), arena.task.obs_size)))
    observations, actions, rewards = [obs], [], []
    length = np.zeros(len(filled), np.int64)
    terminated = np.zeros(len(filled), bool)
    running = ~watch.broken
    use = PlannerUse()
    for step in range(arena.episode_length):
        started = time.perf_counter()
        choice = policy(obs)
        seconds = time.perf_counter() - started
        use += PlannerUse.of_step(choice, running[:wanted])
        if step and choice.timed:  # the first one may compile
            use += PlannerUse(timed_steps=len(filled), seconds=seconds)
        with watch.raising(f"step {step + 1}"):
            obs, reward, ends, cut, info = arena.vector.step(env_action(arena.task, choice.action))
        watch.running = running
        watch.note(info, step + 1)
        obs = watch.finite(obs, "obs", step + 1, observations[-1])
        observations.append(obs)
        rewards.append(watch.finite(reward, "reward", step + 1, np.zeros(len(filled))))
        actions.append(choice.action)
        length += running
        terminated |= running & ends
        running &= ~(ends | cut | watch.broken)
        on_step(wanted)
        if not running[:wanted].any():
            break
    table = np.stack(observations, 1), np.stack(actions, 1), np.stack(rewards, 1)
    trajectories = [
        _cut(table, row, int(length[row]), filled[row], bool(terminated[row]))
        for row in range(wanted)
        if not watch.broken[row]
    ]
    return Rollout(trajectories, use, watch.among(wanted))


def fill(episodes: Sequence[Episode], num_envs: int) -> list[Episode]:
    """Give every environment of a batch an episode; surplus ones repeat the last."""
    return [*episodes, *[episodes[-1]] * (num_envs - len(episodes))]


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
