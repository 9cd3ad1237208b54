"""Acting in many environments at once and recording what happens.

One vector environment and one compiled agent serve collection and evaluation alike.
"""

import contextlib
import dataclasses
import operator
import time
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from typing import TYPE_CHECKING, Any, Literal, NamedTuple, Self

import jax
import numpy as np
from jaxtyping import Float, Int, PRNGKeyArray, UInt8

from headway.config import LARGEST, Config, differences
from headway.data import Trajectory
from headway.errors import BadEnvironmentError, HeadwayError, one_line, shown
from headway.planning.agent import Agent
from headway.sim_params import SimParamSets
from headway.spaces import Spaces
from headway.task import Task, env_action, env_options, episode_length, sim_param_sets, task_of
from headway.training.files import Arrays
from headway.training.run import Partial, trajectories_from, trajectory_arrays

if TYPE_CHECKING:
    from headway.envs import HeadwayVectorEnv


@dataclasses.dataclass(frozen=True)
class Episode:
    """Physics and seed, which define an episode before it is run."""

    sim_params: dict[str, float]
    seed: int


@dataclasses.dataclass(frozen=True)
class Environments:
    """The vector environment that a run acts in, and its Task."""

    name: str
    """Short name of the environment."""
    task: Task
    vector: "HeadwayVectorEnv"
    sim_params: SimParamSets
    episode_length: int

    @classmethod
    def make(cls, config: Config, *, single: bool = False, film: bool = False) -> "Environments":
        """Make as many as a configuration collects episodes, or a single one in this process.

        One for a film can be drawn; it runs in a process of its own where the others do.

        Raises:
            BadEnvironmentError: It cannot be made, its spaces do not fit its Task or its run, or
                no plan is made in such spaces.
        """
        from headway import envs  # a controller is loaded without a simulator

        collection, options = config.collection, env_options(config)
        sim_params, apart = sim_param_sets(config), collection.env_processes and not single
        with raising(config.env, "creation" + film * " with render_mode, to be filmed"):
            vector = envs.make_vec(
                config.env,
                1 if single or film else collection.num_episodes,
                sim_params=sim_params,
                options=options,
                episode_length=episode_length(config),
                step_timeout_s=collection.step_timeout_s if apart else None,
                render_mode="rgb_array" if film else None,
            )
        try:
            task = _task_in(config, vector.spaces)
        except Exception:
            vector.close()
            raise
        return cls(config.env, task, vector, sim_params, episode_length(config))

    def frame(self) -> UInt8[np.ndarray, "height width 3"]:
        """Draw the first environment.

        Raises:
            BadEnvironmentError: It gave no picture.
        """
        image: Any = next(iter(self.vector.render() or ()), None)
        kind = getattr(image, "dtype", type(image).__name__)
        if kind != np.uint8 or image.ndim != 3:
            raise BadEnvironmentError(
                f"render() gave {kind}, allowed: an image of type uint8 and shape"
                " [height, width, 3], as with render_mode='rgb_array'."
            )
        return image

    def close(self) -> None:
        """Free what the environments hold, and end their processes."""
        with raising(self.name, "closing"):
            self.vector.close()


def _task_in(config: Config, read: Spaces) -> Task:
    """The Task of a run, told the spaces of its environment; what it states itself counts.

    Raises:
        BadEnvironmentError: They contradict each other, or actions are not bounded.
    """
    task = task_of(dataclasses.replace(config, spaces=read))
    low, high = tuple(task.action_low), tuple(task.action_high)
    stated = task.obs_size, task.action_size, len(low), len(high)
    found = read.obs_size, read.action_size, *2 * [len(read.action_low)]
    if stated != found:
        raise BadEnvironmentError(
            f"the Task of {config.env} states {stated} as obs_size, action_size and numbers of"
            f" bounds, but its environment has {found}; correct the Task, or let it state none."
        )
    width, whole = np.subtract(high, low), read.action_kind != "box"
    widest = LARGEST if whole else np.finfo(np.float32).max
    if not ((width + whole > 0) & (width <= widest)).all():
        raise BadEnvironmentError(
            f"the actions of {config.env} have action_low {shown(low)} and action_high"
            f" {shown(high)}, allowed: finite bounds, the lower one first; correct the space, or"
            " state both in the Task."
        )
    spaces = dataclasses.replace(read, action_low=low, action_high=high)
    told = dataclasses.replace(config, spaces=spaces)
    if config.spaces and (changed := differences(config, told)):
        raise BadEnvironmentError(
            f"{config.env} has other spaces than its run ({'; '.join(changed)}); bring them back,"
            " or train another run."
        )
    return task_of(told)


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
    agent: Agent, num_envs: int, episodes: Sequence[Episode], *, key: PRNGKeyArray
) -> Policy:
    """An agent that remembers each environment; it starts with an empty memory.

    Args:
        agent: The agent.
        num_envs: Environments of the batch.
        episodes: What they run, for an agent that is told the physics; surplus environments
            repeat the last episode.
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
    episodes: Sequence[Episode],
    policy: Policy,
    on_step: Callable[[int], None] = lambda steps: None,
) -> Rollout:
    """Run at most one episode in each environment of the batch, side by side.

    Args:
        environments: Surplus ones repeat the last episode and are dropped.
        episodes: Physics and seeds, at most as many as there are environments.
        policy: Chooses the actions.
        on_step: Called after each step with the number of environments that stepped.

    An episode that breaks (`HeadwayVectorEnv`), or with a number that is not finite, ends there
    and is left out; the other environments go on.

    Raises:
        BadEnvironmentError: The environment raised, or returned something misshapen.
    """
    begun = time.perf_counter()
    wanted, vector = len(episodes), environments.vector
    filled = fill(episodes, vector.num_envs)
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
        planned = running[:wanted]
        timed = step > 1  # the first one may compile
        use += PlannerUse(
            int(planned.sum()),
            int(choice.failures[:wanted][planned].sum()),
            int(choice.evaluations[:wanted][planned].sum()),
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
        on_step(wanted)
        if not running[:wanted].any():
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
        for row, episode in enumerate(episodes)
        if row not in valid.reasons
    }
    invalid = {row: valid.reasons[row] for row in sorted(valid.reasons) if row < wanted}
    return Rollout(trajectories, use, invalid, time.perf_counter() - begun)


@contextlib.contextmanager
def raising(name: str, when: str) -> Iterator[None]:
    """Turn whatever the environment `name` raises into one line that says when.

    Raises:
        BadEnvironmentError: It raised.
    """
    try:
        yield
    except BadEnvironmentError as error:
        raise BadEnvironmentError(f"{name} at {when}: {error}") from error
    except HeadwayError:
        raise
    except Exception as error:
        raise BadEnvironmentError(
            f"{name} raised {type(error).__name__} at {when}: {one_line(error, 300)}; correct the"
            " environment, then the same command goes on."
        ) from error


def fill(episodes: Sequence[Episode], num_envs: int) -> list[Episode]:
    """Give every environment of a batch an episode; surplus ones repeat the last."""
    return [*episodes, *[episodes[-1]] * (num_envs - len(episodes))]


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
        episodes: Sequence[Episode],
        policy: Callable[[], Policy],
        counted: Collection[int] | None = None,
    ) -> Rollout:
        """Run a batch, unless it was finished before.

        Args:
            name: Of the batch.
            episodes: At most as many as there are environments.
            policy: Makes the policy that chooses the actions.
            counted: Places of the episodes that must not break too often; all of them by default.

        Raises:
            BadEnvironmentError: More episodes broke than allowed, or the environment raised.
        """
        kept = self.partial.load(name) if self.partial else None
        if kept is None:
            rollout = run_episodes(self.environments, episodes, policy(), self.on_step)
        else:
            rollout = Rollout.from_part(*kept)
            self.on_step(len(episodes) * self.environments.episode_length)
        invalid = rollout.invalid.items()
        broken = [reason for place, reason in invalid if counted is None or place in counted]
        self.reasons += broken
        if len(self.reasons) > self.allowed:
            raise self.too_many()
        for reason in broken:
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
