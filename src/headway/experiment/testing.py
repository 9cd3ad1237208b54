"""Running the test episodes of a trained run once more, outside of its training."""

import dataclasses
from collections.abc import Mapping, Sequence
from contextlib import closing
from pathlib import Path
from typing import Any

import jax

from headway.config import Config
from headway.data import Trajectory
from headway.errors import unknown_name
from headway.experiment.evaluation import Tests, evaluate_agent, trajectories_of
from headway.experiment.limits import check_memory, make_room_for_programs
from headway.experiment.loading import load_agent, need_of
from headway.experiment.methods import config_to_evaluate
from headway.experiment.rollouts import Arena, PlannerUse
from headway.planning.acting import Acting
from headway.storage.run_dir import RunDir
from headway.training.progress import Progress


@dataclasses.dataclass(frozen=True)
class Tested:
    """Test episodes, and what they were run with."""

    config: Config
    """All settings, as they were tested."""
    iteration: int
    """The run's last finished iteration."""
    agent: Acting
    arena: Arena
    tests: Tests
    use: PlannerUse
    """What planning took."""

    @property
    def trajectories(self) -> dict[str, list[Trajectory]]:
        """By group, in the order of the episodes."""
        return trajectories_of(self.tests)


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
        LimitError: Planning needs more memory than is free.
    """
    run = RunDir(run_dir)
    changes = dict(settings or {})
    if num_episodes is not None:
        changes["evaluation.num_episodes"] = num_episodes
    config = config_to_evaluate(run.config(), changes)
    make_room_for_programs()
    check_memory(need_of(config).to_test)
    arena = Arena.make(config)
    with progress or Progress() as shown, closing(arena):
        agent = load_agent(run, config, arena)
        groups = known_groups(groups, arena.sim_params.group_names)
        iteration = run.finished_iterations - 1
        total = len(groups) * config.evaluation.num_episodes * arena.episode_length
        shown.phase("evaluate", total)
        key = jax.random.key(config.evaluation.seed)
        found, use = evaluate_agent(agent, arena, config, groups, key=key, progress=shown)
    return Tested(config, iteration, agent, arena, found, use)


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
