"""Testing a controller on training and unseen physics (supplement A.2)."""

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from contextlib import closing
from pathlib import Path
from typing import Any

import jax
from jaxtyping import PRNGKeyArray

from headway.config import Config
from headway.data import Trajectory
from headway.errors import unknown_name
from headway.planning.agent import Agent
from headway.planning.flop import plan_flop
from headway.sim_params import SimParamSets
from headway.task import Task
from headway.training.collect import (
    AgentPolicy,
    Environments,
    Episode,
    InvalidEpisodes,
    PlannerUse,
    Rollout,
    run_episodes,
)
from headway.training.loading import load_agent
from headway.training.methods import config_to_evaluate
from headway.training.progress import Progress
from headway.training.run import EpisodeRow, Partial, RunDir

GROUP_SEEDS = 1000  # seeds reserved for each group, so that groups never share an episode


@dataclasses.dataclass(frozen=True)
class Tests:
    """Test episodes, and what planning them took."""

    episodes: dict[str, dict[int, Trajectory]] = dataclasses.field(default_factory=dict)
    """By group, and by their number in it; invalid ones are left out."""
    use: PlannerUse = dataclasses.field(default_factory=PlannerUse)
    seconds: float = 0.0

    @property
    def trajectories(self) -> dict[str, list[Trajectory]]:
        """The test episodes of each group, in their order."""
        return {group: list(found.values()) for group, found in self.episodes.items()}

    def rows(self, config: Config, iteration: int) -> list[EpisodeRow]:
        """Rows of `evaluation.csv`."""
        run = config.method, config.env, config.seed, iteration
        return [
            EpisodeRow(*run, group, found.sim_params, number, found.returns, len(found))
            for group, episodes in self.episodes.items()
            for number, found in episodes.items()
        ]


@dataclasses.dataclass(frozen=True)
class PlanningCost:
    """Cost of planning one step of one environment, on average over some episodes."""

    evaluations_per_step: float
    """Candidates that were scored; fewer than the settings allow where searches end early."""
    flop_per_step: float
    """Floating-point operations of the matrix products of their rollouts."""
    seconds_per_step: float | None
    """Time to choose the actions of a batch, over its size; None if nothing was timed.

    The first step of each batch is left out, because it may compile.
    """

    @classmethod
    def of(cls, use: PlannerUse, config: Config, task: Task) -> "PlanningCost":
        """The averages of what was counted."""
        evaluations = use.evaluations / use.steps
        return cls(
            evaluations,
            plan_flop(config.model, config.planner, task, evaluations),
            use.seconds / use.timed_steps if use.timed_steps else None,
        )


def group_episodes(
    sim_params: SimParamSets, group: str, num_episodes: int, first_seed: int
) -> list[Episode]:
    """The test episodes of a group: fixed, distinct seeds, physics spread evenly.

    Args:
        sim_params: The run's simulator parameters.
        group: `train` or an unseen group.
        num_episodes: How many.
        first_seed: Where the seeds of the first group begin.

    Raises:
        UnknownNameError: No such group.
    """
    physics = sim_params.spread(group, num_episodes)
    first = first_seed + GROUP_SEEDS * list(sim_params.group_names).index(group)
    return [Episode(each, first + i) for i, each in enumerate(physics)]


def evaluate_agent(  # noqa: PLR0913
    agent: Agent,
    environments: Environments,
    config: Config,
    groups: Sequence[str],
    *,
    key: PRNGKeyArray,
    progress: Progress,
    on_step: Callable[[int], None] | None = None,
    partial: Partial | None = None,
) -> Tests:
    """Run the test episodes of some groups, as many side by side as the batch holds.

    Args:
        agent: The agent to test.
        environments: Where it acts.
        config: Settings of the run.
        groups: `train` or unseen groups.
        key: The planner's draws.
        progress: Counts the steps, and says which episodes broke.
        on_step: Called with the number of steps instead of `progress.advance`.
        partial: Keeps finished episodes, for when the process is killed.

    Raises:
        BadEnvironmentError: More episodes broke than allowed, or all of a group.
    """
    evaluation, size = config.evaluation, environments.vector.num_envs
    episodes = [
        (group, number, episode)
        for group in groups
        for number, episode in enumerate(
            group_episodes(environments.sim_params, group, evaluation.num_episodes, evaluation.seed)
        )
    ]
    found: dict[str, dict[int, Trajectory]] = {group: {} for group in groups}
    use, seconds, on_step = PlannerUse(), 0.0, on_step or progress.advance
    invalid = InvalidEpisodes(
        "evaluation.max_bad_episodes", evaluation.max_bad_episodes, progress.message
    )
    for chunk, start in enumerate(range(0, len(episodes), size)):
        batch = episodes[start : start + size]
        side_by_side = [episode for _, _, episode in batch]
        kept = partial.load(f"evaluate-{chunk}") if partial else None
        if kept is not None:
            rollout = Rollout.from_part(*kept)
            progress.advance(len(batch) * environments.episode_length)
        else:
            chunk_key = jax.random.fold_in(key, chunk)
            policy = AgentPolicy(agent, size, side_by_side, key=chunk_key)
            rollout = run_episodes(environments, side_by_side, policy, on_step)
        invalid.leave_out(rollout)
        if partial and kept is None:
            partial.save(f"evaluate-{chunk}", *rollout.to_part())
        use, seconds = use + rollout.use, seconds + rollout.seconds
        for place, trajectory in zip(rollout.numbers, rollout.trajectories, strict=True):
            group, number, _ = batch[place]
            found[group][number] = trajectory
    if not all(found.values()):
        if partial:  # when the environment is mended, they are run again
            partial.remove("evaluate-*")
        raise invalid.too_many()
    return Tests(found, use, seconds)


@dataclasses.dataclass(frozen=True)
class Tested:
    """Test episodes of a trained run, and what they were run with."""

    config: Config
    """All settings, as they were tested."""
    iteration: int
    """The run's last finished iteration."""
    agent: Agent
    task: Task
    tests: Tests


def run_tests(
    run_dir: str | Path,
    *,
    groups: Sequence[str] | None = None,
    num_episodes: int | None = None,
    settings: Mapping[str, Any] | None = None,
    progress: Progress | None = None,
) -> Tested:
    """Run test episodes with the run's protocol; nothing in its directory changes.

    Args:
        run_dir: The run directory.
        groups: `train` or unseen groups; all of them by default.
        num_episodes: Episodes per group; the run's own number by default.
        settings: Changes of `planner` and `evaluation` settings by dotted name.
        progress: Shown while testing; silent by default.

    Raises:
        RunError: There is no trained run, or it is damaged.
        UnknownNameError: No such group.
        ConfigError: A setting is unknown, of the wrong type or out of range, or one that
            training has fixed.
    """
    run, changes = RunDir(run_dir), dict(settings or {})
    if num_episodes is not None:
        changes["evaluation.num_episodes"] = num_episodes
    config = config_to_evaluate(run.config(), changes)
    with closing(Environments.make(config)) as environments, progress or Progress() as shown:
        agent = load_agent(run, config, environments)
        groups = known_groups(groups, environments.sim_params.group_names)
        total = len(groups) * config.evaluation.num_episodes * environments.episode_length
        shown.phase("evaluate", total)
        key = jax.random.key(config.evaluation.seed)
        tests = evaluate_agent(agent, environments, config, groups, key=key, progress=shown)
    return Tested(config, run.last_iteration, agent, environments.task, tests)


def known_groups(wanted: Sequence[str] | None, known: Sequence[str]) -> list[str]:
    """The wanted groups, each once; all by default.

    Args:
        wanted: `train` or unseen groups, as they were asked for.
        known: All that there are.

    Raises:
        UnknownNameError: No such group.
    """
    for group in wanted or ():
        if group not in known:
            raise unknown_name("group", group, known)
    return list(dict.fromkeys(wanted or known))
