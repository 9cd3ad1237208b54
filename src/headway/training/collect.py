"""Acting in many environments at once and recording what happens.

One vector environment and one compiled agent serve collection and evaluation alike.
"""

import dataclasses
import operator
import time
from collections.abc import Callable, Mapping, Sequence
from typing import Any, Literal, NamedTuple, Self

import jax
import numpy as np
from jaxtyping import Float, Int, PRNGKeyArray

from headway.config import Config
from headway.data import Trajectory
from headway.errors import BadEnvironmentError, one_line
from headway.planning.agent import Agent
from headway.task import env_action
from headway.training.environments import Environments, raising
from headway.training.files import Arrays
from headway.training.run import Partial, trajectories_from, trajectory_arrays


@dataclasses.dataclass(frozen=True)
class Episode:
    """Physics and seed, which define an episode before it is run."""

    sim_params: dict[str, float]
    seed: int


class Choice(NamedTuple):
    """A policy's choice for every environment of a batch."""

    action: Float[np.ndarray, "env action"]
    """The actions to take, in [-1, 1]."""
    failures: Int[np.ndarray, " env"]
    """Planner iterations that found nothing finite."""
    evaluations: Int[np.ndarray, " env"]
    """Candidates that the planner scored."""


Policy = Callable[[Float[np.ndarray, "env obs"]], Choice]
"""Chooses scaled actions for a batch of environments, step by step."""


def random_policy(environments: Environments, rng: np.random.Generator) -> Policy:
    """Uniform random actions, as in the first iteration."""
    num_envs = environments.vector.num_envs
    shape, none = (num_envs, environments.task.action_size), np.zeros(num_envs, int)

    def choose(obs: Float[np.ndarray, "env obs"]) -> Choice:
        draws = rng.uniform(-1.0, 1.0, shape).astype(np.float32)
        return Choice(environments.task.spaces.project(draws, np), none, none)

    return choose


def agent_policy(
    agent: Agent, num_envs: int, episodes: Sequence[Episode | None], *, key: PRNGKeyArray
) -> Policy:
    """An agent that remembers each environment; it starts with an empty memory.

    Args:
        agent: The agent.
        num_envs: Environments of the batch.
        episodes: What they run, as in `run_episodes`, for an agent that is told the physics.
        key: The planner's draws.
    """
    physics = [episode.sim_params for episode in fill(episodes, num_envs)]
    state = agent.init(num_envs, key=key, sim_params=physics)

    def choose(obs: Float[np.ndarray, "env obs"]) -> Choice:
        nonlocal state
        state, decision = agent.act(state, obs)
        return Choice(*jax.device_get((decision.action, decision.failures, decision.evaluations)))

    return choose


@dataclasses.dataclass(frozen=True)
class PlannerUse:
    """Cost of planning over some episodes; sums with `+`."""

    steps: int = 0
    """Environment steps that were planned."""
    failures: int = 0
    """Planner iterations that found nothing finite."""
    evaluations: int = 0
    """Candidates that were scored."""
    timed_steps: int = 0
    """Environment steps that were timed, those of surplus environments included."""
    seconds: float = 0.0
    """Of the timed steps."""

    def __add__(self, other: "PlannerUse") -> "PlannerUse":
        return PlannerUse(*map(operator.add, dataclasses.astuple(self), dataclasses.astuple(other)))


@dataclasses.dataclass(frozen=True)
class Rollout:
    """Finished episodes by their number among those asked for, without the invalid ones."""

    episodes: dict[int, Trajectory]
    use: PlannerUse
    invalid: dict[int, str]
    """Why an episode is left out, by its number."""
    seconds: float
    """Of all of it."""

    def to_part(self) -> tuple[Arrays, dict[str, Any]]:
        """Arrays and facts for `Partial.save`."""
        arrays, facts = trajectory_arrays(list(self.episodes.values()))
        facts |= {"numbers": list(self.episodes), "use": dataclasses.asdict(self.use)}
        return arrays, facts | {"invalid": list(self.invalid.items()), "seconds": self.seconds}

    @classmethod
    def from_part(cls, arrays: Arrays, facts: Mapping[str, Any]) -> Self:
        """Build what `to_part` took apart."""
        episodes = dict(zip(facts["numbers"], trajectories_from(arrays, facts), strict=True))
        use, invalid = PlannerUse(**facts["use"]), dict(facts["invalid"])
        return cls(episodes, use, invalid, facts["seconds"])


def run_episodes(
    environments: Environments,
    episodes: Sequence[Episode | None],
    policy: Policy,
    on_step: Callable[[int], None] = lambda steps: None,
) -> Rollout:
    """Run at most one episode in each environment of the batch, side by side.

    Args:
        environments: Where they run; one that has no episode repeats the first and is dropped.
        episodes: Physics and seeds by place, at most as many as there are environments.
        policy: Chooses the actions.
        on_step: Called after each step with the number of environments that stepped.

    An episode that breaks (`HeadwayVectorEnv`), or with a number that is not finite, ends there
    and is left out; the other environments go on.

    Raises:
        BadEnvironmentError: The environment raised, or returned something misshapen.
    """
    begun = time.perf_counter()
    vector = environments.vector
    filled = fill(episodes, vector.num_envs)
    asked = {row: episode for row, episode in enumerate(episodes) if episode}
    wanted = np.isin(np.arange(len(filled)), [*asked])
    seeds: Any = [episode.seed for episode in filled]
    physics = [episode.sim_params for episode in filled]
    columns = {name: np.array([one[name] for one in physics]) for name in physics[0]}
    valid = _ValidityFilter(environments.name, physics)
    running = valid.running
    with raising(environments.name, "reset"):
        obs, info = vector.reset(seed=seeds, options={"sim_params": columns})
    valid.heed(info, 0)
    obs = valid.finite(obs, "obs", 0, np.zeros((len(filled), environments.task.obs_size)))
    observations, actions, rewards = [obs], [], []
    length = np.zeros(len(filled), np.int64)
    terminated = np.zeros(len(filled), bool)
    use = PlannerUse()
    for step in range(1, environments.episode_length + 1):
        started = time.perf_counter()
        choice = policy(obs)
        seconds = time.perf_counter() - started
        planned = running & wanted
        timed = step > 1  # the first one may compile
        use += PlannerUse(
            int(planned.sum()),
            int(choice.failures[planned].sum()),
            int(choice.evaluations[planned].sum()),
            timed * len(filled),
            timed * seconds,
        )
        with raising(environments.name, f"step {step}"):
            obs, reward, ends, cut, info = vector.step(env_action(environments.task, choice.action))
        valid.heed(info, step)
        obs = valid.finite(obs, "obs", step, observations[-1])
        observations.append(obs)
        rewards.append(valid.finite(reward, "reward", step, np.zeros(len(filled))))
        actions.append(choice.action)
        length += running
        terminated |= running & ends
        running &= ~(ends | cut)
        on_step(len(asked))
        if not running[wanted].any():
            break
    table = np.stack(observations, 1), np.stack(actions, 1), np.stack(rewards, 1)
    trajectories = {
        row: Trajectory(
            obs=table[0][row, : length[row] + 1].astype(np.float32),
            action=table[1][row, : length[row]].astype(np.float32),
            reward=table[2][row, : length[row]].astype(np.float64),
            sim_params=episode.sim_params,
            terminated=bool(terminated[row]),
        )
        for row, episode in asked.items()
        if row not in valid.reasons
    }
    invalid = {row: valid.reasons[row] for row in asked if row in valid.reasons}
    return Rollout(trajectories, use, invalid, time.perf_counter() - begun)


def fill(episodes: Sequence[Episode | None], num_envs: int) -> list[Episode]:
    """Give every environment of a batch an episode; those without one repeat the first."""
    first = next(filter(None, episodes))
    return [episode or first for episode in (*episodes, *[None] * (num_envs - len(episodes)))]


class _ValidityFilter:
    """Looks at what the environments return, and notes the episodes that break.

    Args:
        name: The environment's.
        physics: Simulator parameters of each environment of the batch.
    """

    def __init__(self, name: str, physics: Sequence[Mapping[str, float]]):
        self._name, self._physics = name, physics
        self.running = np.ones(len(physics), bool)
        """Cleared where an episode breaks; its other ends are for the caller to clear."""
        self.reasons: dict[int, str] = {}

    def _note(self, row: int, reason: str) -> None:
        if self.running[row]:
            self.running[row] = False
            self.reasons[row] = reason

    def heed(self, info: Mapping[str, Any], step: int) -> None:
        """Note the episodes of which the environments themselves say that they broke."""
        for row, reason in info.get("broken", {}).items():
            where = f"{self._name} broke at step {step} under {self._physics[row]}"
            self._note(row, f"{where}: {one_line(reason, 300)}")

    def finite(self, values: Any, what: str, step: int, instead: np.ndarray) -> np.ndarray:
        """Replace what is not finite by `instead`, and note those episodes.

        Raises:
            BadEnvironmentError: The values have another shape, or are no numbers.
        """
        values = np.asarray(values)
        if values.shape != instead.shape or values.dtype.kind not in "fiub":
            raise BadEnvironmentError(
                f"{self._name} returned {what} of shape {values.shape} and type {values.dtype} at"
                f" step {step}, allowed: numbers of shape {instead.shape}; correct the environment."
            )
        with np.errstate(over="ignore"):  # too large for float32 is as bad
            bad = ~np.isfinite(values.astype(np.float32).reshape(len(values), -1)).all(1)
        for row in np.flatnonzero(bad).tolist():
            where = f"a non-finite {what} at step {step} under {self._physics[row]}"
            self._note(row, f"{self._name} returned {where}")
        return np.where(bad.reshape(-1, *[1] * (values.ndim - 1)), instead, values)


@dataclasses.dataclass
class Batches:
    """Runs batches of episodes; keeps what is finished, and stops where too many are invalid."""

    environments: Environments
    config: Config
    phase: Literal["collection", "evaluation"]
    """Whose setting `max_bad_episodes` holds."""
    on_step: Callable[[int], None]
    """Called with the number of environments that stepped."""
    say: Callable[[str], None]
    """Shows a line."""
    partial: Partial | None = None
    """Keeps finished batches, for when the process is killed."""
    reasons: list[str] = dataclasses.field(default_factory=list)
    """Why episodes were left out so far."""
    failures: int = 0
    """Planner iterations that found nothing finite so far."""

    @property
    def allowed(self) -> int:
        """Most episodes that may be left out."""
        return getattr(self.config, self.phase).max_bad_episodes

    def run(
        self,
        name: str,
        episodes: Sequence[Episode | None],
        policy: Callable[[], Policy],
    ) -> Rollout:
        """Run a batch, unless it was finished before.

        Args:
            name: Of the batch.
            episodes: As in `run_episodes`.
            policy: Makes the policy that chooses the actions.

        Raises:
            BadEnvironmentError: More episodes broke than allowed, or the environment raised.
        """
        kept = self.partial.load(name) if self.partial else None
        if kept is None:
            rollout = run_episodes(self.environments, episodes, policy(), self.on_step)
        else:
            rollout = Rollout.from_part(*kept)
            self.on_step(sum(map(bool, episodes)) * self.environments.episode_length)
        self.reasons += rollout.invalid.values()
        if len(self.reasons) > self.allowed:
            raise self.too_many()
        for reason in rollout.invalid.values():
            self.say(f"{reason}; the episode is dropped.")
        if rollout.use.failures and not self.failures:
            tried = rollout.use.steps * self.config.planner.num_iterations
            self.say(
                f"{self.phase}: {rollout.use.failures} of {tried} planner iterations found"
                " no finite return; actions follow older plans or are 0. Check the Task's reward."
            )
        self.failures += rollout.use.failures
        if self.partial and kept is None and rollout.episodes:
            self.partial.save(name, *rollout.to_part())
        return rollout

    def too_many(self) -> BadEnvironmentError:
        """Word the error for more invalid episodes than allowed, or for nothing else."""
        return BadEnvironmentError(
            f"{len(self.reasons)} episodes broke, allowed: {self.allowed}"
            f" ({self.phase}.max_bad_episodes), and not all; the first: {self.reasons[0]}. Mend"
            " the environment under these physics, or allow more; then the same command goes on."
        )
