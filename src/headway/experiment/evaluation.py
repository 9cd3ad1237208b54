"""Testing a controller on training and unseen physics (supplement A.2)."""

import dataclasses
import functools
from collections.abc import Sequence

import jax
from jaxtyping import PRNGKeyArray

from headway.config import Config
from headway.data import Trajectory
from headway.experiment.bad_episodes import BadEpisodes
from headway.experiment.resumable import resumable_episodes
from headway.experiment.rollouts import (
    AgentPolicy,
    Arena,
    Episode,
    PlannerUse,
    run_episodes,
)
from headway.planning.acting import Acting
from headway.planning.flop import plan_flop
from headway.sim_params import SimParamSets
from headway.storage.progress_store import ProgressStore
from headway.storage.tables import EpisodeRow
from headway.task import Task
from headway.training.progress import Progress

GROUP_SEEDS = 1000  # seeds reserved for each group, so that groups never share an episode


Tests = dict[str, dict[int, Trajectory]]
"""Test episodes by group, and by their number in it; those that broke are left out."""


@dataclasses.dataclass(frozen=True)
class PlanningCost:
    """What planning one step of one environment took, on average over some episodes."""

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


def evaluate_agent(
    agent: Acting,
    arena: Arena,
    config: Config,
    groups: Sequence[str],
    *,
    key: PRNGKeyArray,
    progress: Progress,
    store: ProgressStore | None = None,
) -> tuple[Tests, PlannerUse]:
    """Run the test episodes of some groups, as many side by side as the batch holds.

    Args:
        agent: The agent to test.
        arena: The environments.
        config: Settings of the run.
        groups: `train` or unseen groups.
        key: The planner's draws.
        progress: Counts the steps, and says which episodes broke.
        store: Keeps what is done, for when the process is killed.

    Returns:
        The episodes of each group in their order, and what planning them took.

    Raises:
        BadEnvironmentError: More episodes broke than allowed, or all of a group.
    """
    evaluation = config.evaluation
    episodes = [
        (group, number, episode)
        for group in groups
        for number, episode in enumerate(
            group_episodes(arena.sim_params, group, evaluation.num_episodes, evaluation.seed)
        )
    ]
    found: Tests = {group: {} for group in groups}
    size, use = arena.vector.num_envs, PlannerUse()
    allowed, forget = evaluation.max_bad_episodes, store.drop if store else lambda name: None
    bad = BadEpisodes("evaluation.max_bad_episodes", allowed, progress.message, forget)
    for chunk, start in enumerate(range(0, len(episodes), size)):
        batch = episodes[start : start + size]
        chunk_key = jax.random.fold_in(key, chunk)
        side_by_side = [episode for _, _, episode in batch]
        policy = functools.partial(AgentPolicy, agent, size, side_by_side, key=chunk_key)
        name = f"evaluate-{chunk}"
        if store is None:
            rollout = run_episodes(arena, side_by_side, policy(), progress.advance)
        else:
            rollout = resumable_episodes(store, name, arena, side_by_side, policy, progress.advance)
        bad.leave_out(name, list(rollout.broken.values()))
        use += rollout.use
        for place, trajectory in zip(rollout.numbers, rollout.trajectories, strict=True):
            group, number, _ = batch[place]
            found[group][number] = trajectory
    bad.want_some(min(map(len, found.values()), default=1))
    return found, use


def trajectories_of(tests: Tests) -> dict[str, list[Trajectory]]:
    """The test episodes of each group, in their order."""
    return {group: list(found.values()) for group, found in tests.items()}


def episode_rows(config: Config, iteration: int, tests: Tests) -> list[EpisodeRow]:
    """Turn test episodes into rows of `evaluation.csv`."""
    return [
        EpisodeRow(
            config.method,
            config.env,
            config.seed,
            iteration,
            group,
            trajectory.sim_params,
            number,
            trajectory.returns,
            len(trajectory),
        )
        for group, found in tests.items()
        for number, trajectory in found.items()
    ]
