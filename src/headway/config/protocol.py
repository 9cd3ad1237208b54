"""Settings of the protocol: what is collected, and what is tested."""

import dataclasses
from typing import Literal

from headway.problems import Problems


@dataclasses.dataclass(frozen=True)
class CollectionConfig:
    """How much data is collected (supplement A.2)."""

    num_iterations: int = 10
    """Rounds of collecting and fitting; the first one acts at random."""
    num_episodes: int = 10
    """Episodes per iteration, all stepped and planned together."""
    episode_length: int = 0
    """Steps per episode; 0 takes the environment's own."""
    max_bad_episodes: int = 1
    """Most episodes of an iteration that are dropped because they broke: a number was not finite,
    a simulation diverged, a process hung or died."""
    env_processes: bool = False
    """Whether every environment runs in a process of its own, also in tests, so that one that
    hangs or crashes costs its episode only; slower where steps are quick."""
    step_timeout_s: float = 60.0
    """Seconds that a step or reset may take before its process is given up (env_processes)."""

    def __post_init__(self):
        problems = Problems(self)
        problems.at_least(1, "num_iterations", "num_episodes")
        problems.at_least(0, "episode_length", "max_bad_episodes")
        problems.between(1e-3, 1e6, "step_timeout_s")
        problems.report()


@dataclasses.dataclass(frozen=True)
class EvaluationConfig:
    """How controllers are tested; test episodes have fixed seeds, the same for every method."""

    every: int = 1
    """Iterations between tests on the unseen groups; the last iteration is always tested."""
    num_episodes: int = 10
    """Episodes per group, spread evenly over the group's simulator parameters."""
    training_group: Literal["last", "always"] = "last"
    """When the training physics are tested too: after the last iteration, or at every test."""
    seed: int = 10_000
    """Seed of the first test episode; the others follow it."""
    max_bad_episodes: int = 0
    """Most test episodes of an iteration that are left out because they broke; what is left may
    look better than it is."""

    def __post_init__(self):
        problems = Problems(self)
        problems.at_least(1, "every")
        problems.at_least(0, "max_bad_episodes")
        problems.between(1, 1000, "num_episodes")
        problems.between(0, 2**30, "seed")
        problems.one_of("training_group", ("last", "always"))
        problems.report()
