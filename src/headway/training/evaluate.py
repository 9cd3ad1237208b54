"""Testing a controller on training and unseen physics (supplement A.2)."""

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from contextlib import closing
from functools import partial
from pathlib import Path
from typing import Any, Self

import jax
import numpy as np
from jaxtyping import PRNGKeyArray
from numpy.typing import ArrayLike

from headway.config import Config, differences, override, tolerating_as
from headway.data import Trajectory
from headway.errors import check_names
from headway.planning.agent import Agent
from headway.planning.rollouts import plan_flop
from headway.sim_params import SimParamSets
from headway.task import Task, env_spec, sim_param_sets
from headway.training.collect import Batches, Episode, PlannerUse, agent_policy
from headway.training.environments import Environments
from headway.training.methods import config_to_evaluate
from headway.training.progress import Progress
from headway.training.run import EpisodeRow, Iteration, RunDir, format_sim_params
from headway.training.trainers import load_agent

GROUP_SEEDS = 1000  # seeds reserved for each group, so that groups never share an episode
CUSTOM = "custom"  # group of physics that an evaluation names itself


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
    def of(cls, use: PlannerUse, config: Config, task: Task) -> Self:
        """Divide what was used by the steps that were planned."""
        evaluations = use.evaluations / use.steps
        return cls(
            evaluations,
            plan_flop(config.model, config.planner, task, evaluations),
            use.seconds / use.timed_steps if use.timed_steps else None,
        )


@dataclasses.dataclass(frozen=True)
class Evaluation(Sequence[EpisodeRow]):
    """Test episodes of a trained run, one after the other, and the cost of planning them."""

    rows: list[EpisodeRow]
    """Every test episode."""
    config: Config
    """All settings, as they were tested."""
    cost: PlanningCost
    """Candidates, arithmetic and time per step."""
    trajectories: Mapping[str, list[Trajectory]] = dataclasses.field(default_factory=dict)
    """The same episodes step by step, by group."""

    def __getitem__(self, index: Any) -> Any:
        return self.rows[index]

    def __len__(self) -> int:
        return len(self.rows)

    def __repr__(self) -> str:
        """One line: the returns of each group."""
        name = f"{self.config.method} on {self.config.env}, {len(self)} episodes"
        return f"Evaluation({name}{returns_in_words(self.rows)})"


def returns_in_words(rows: Sequence[EpisodeRow]) -> str:
    """Mean return of each group; every physics of it counts once."""
    groups: dict[str, dict[str, list[float]]] = {}
    for row in rows:
        physics = groups.setdefault(row.group, {})
        physics.setdefault(format_sim_params(row.sim_params), []).append(row.episode_return)
    return "".join(
        f"; {group} {np.mean([np.mean(returns) for returns in physics.values()]):,.1f}"
        for group, physics in groups.items()
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


def iteration_keys(config: Config, iteration: int) -> PRNGKeyArray:
    """Keys of an iteration's collection, fit, tests and errors.

    They come from seed and iteration alone, however often the run was interrupted before.
    """
    return jax.random.split(jax.random.fold_in(jax.random.key(config.seed), iteration + 1), 4)


def run_tests(
    agent: Agent,
    wanted: Sequence[str],
    groups: Sequence[str],
    batches: Batches,
    key: PRNGKeyArray,
    begin: Callable[[int], Any],
) -> Tests:
    """Run the test episodes of some groups, as many side by side as a batch holds.

    Args:
        agent: The agent to test.
        wanted: The groups to test on.
        groups: The same or more, in the order that decides which draws an episode gets.
        batches: Runs them.
        key: The planner's draws.
        begin: Called with the environment steps to come.

    Raises:
        BadEnvironmentError: More episodes broke than allowed, or all of a group.
    """
    evaluation, environments = batches.config.evaluation, batches.environments
    size = environments.vector.num_envs
    asked = [
        (group, number, episode)
        for group in groups
        for number, episode in enumerate(
            group_episodes(environments.sim_params, group, evaluation.num_episodes, evaluation.seed)
        )
    ]
    found: dict[str, dict[int, Trajectory]] = {group: {} for group in wanted}
    use, seconds = PlannerUse(), 0.0
    begin(sum(group in wanted for group, *_ in asked) * environments.episode_length)
    for chunk in range(-(-len(asked) // size)):
        batch = asked[chunk * size : (chunk + 1) * size]
        # Every place has draws of its own, so the episodes that are wanted keep theirs.
        episodes = [episode if group in wanted else None for group, _, episode in batch]
        if not any(episodes):
            continue
        policy = partial(agent_policy, agent, size, episodes, key=jax.random.fold_in(key, chunk))
        rollout = batches.run(f"evaluate-{chunk}", episodes, policy)
        use, seconds = use + rollout.use, seconds + rollout.seconds
        for place, trajectory in rollout.episodes.items():
            group, number, _ = batch[place]
            found[group][number] = trajectory
    if not all(found.values()):
        if batches.partial:  # when the environment is mended, they are run again
            batches.partial.remove("evaluate-*")
        raise batches.too_many()
    return Tests(found, use, seconds)


def evaluate(
    run_dir: str | Path,
    *,
    groups: Sequence[str] | None = None,
    num_episodes: int | None = None,
    sim_params: Mapping[str, ArrayLike] | None = None,
    iteration: Iteration = None,
    settings: Mapping[str, Any] | None = None,
    progress: Progress | None = None,
) -> Evaluation:
    """Test a trained run once more, with its protocol; nothing in its directory changes.

    Where no setting is changed, groups that the run was tested on after this iteration give its
    own numbers again, bit for bit on the same machine. Else the planner's draws are new, which
    `progress` says.

    Args:
        run_dir: The run directory.
        groups: `"train"` or unseen groups; all of them by default.
        num_episodes: Episodes per group; the run's own number by default.
        sim_params: Physics that are in no group, a value or several of each parameter; those that
            are not named go through the training values. They are tested as the group `custom`,
            alone or beside `groups`.
        iteration: The iteration whose model is tested, from 0, or `"best"` by training return; the
            newest by default.
        settings: Changes of `planner` and `evaluation` settings by dotted name, for example
            `{"planner.num_candidates": 50}`, to test the model with another planner.
        progress: Shown while testing; silent by default.

    Raises:
        RunError: There is no trained run, it does not keep the iteration, or it is damaged.
        UnknownNameError: No such group.
        ConfigError: A setting is unknown, of the wrong type or out of range, or one that
            training has fixed; or a simulator parameter is unknown or no number.
    """
    run, changes = RunDir(run_dir), dict(settings or {})
    if num_episodes is not None:
        changes["evaluation.num_episodes"] = num_episodes
    config = config_to_evaluate(run.config(), changes)
    changed = differences(tolerating_as(run.config(), config), config)
    number = run.kept_iteration(iteration)
    tested = [row.group for row in run.evaluation() if row.iteration == number]
    if sim_params:
        sets, usual = sim_param_sets(config), env_spec(config.env).default_sim_params
        told = config.model.context == "sim-params"  # of them, no more and no less
        check_names("sim_param", sim_params, sets.names if told else {*sets.names, *usual})
        added = {name: [usual[name]] for name in sim_params if name not in sets.names}
        known = {**sets.train, **added}
        custom = known | {name: np.atleast_1d(v) for name, v in sim_params.items()}
        unseen = {group: {**values, **added} for group, values in sets.unseen.items()}
        physics = {"train": known, "unseen": {**unseen, CUSTOM: custom}}
        config, groups = override(config, {"sim_params": physics}), [*(groups or ()), CUSTOM]
    with closing(Environments.make(config)) as environments, progress or Progress() as shown:
        agent = load_agent(run, config, environments, number)
        known = environments.sim_params.group_names
        wanted = known_groups(groups, known)
        if new := changed or [f"{group} was not tested" for group in wanted if group not in tested]:
            shown.message(f"New draws, not those of iteration {number}'s tests: {'; '.join(new)}.")
        batches = Batches(environments, config, "evaluation", shown.advance, shown.message)
        seed = config.evaluation.seed
        key = jax.random.key(seed) if changed else iteration_keys(config, number)[2]
        order, begin = list(dict.fromkeys([*tested, *known])), partial(shown.phase, "evaluate")
        tests = run_tests(agent, wanted, order, batches, key, begin)
    cost = PlanningCost.of(tests.use, config, environments.task)
    return Evaluation(tests.rows(config, number), config, cost, tests.trajectories)


def known_groups(wanted: Sequence[str] | None, known: Sequence[str]) -> list[str]:
    """The wanted groups, each once; all by default.

    Args:
        wanted: `train` or unseen groups, as they were asked for.
        known: All that there are.

    Raises:
        UnknownNameError: No such group.
    """
    check_names("group", wanted or (), known)
    return list(dict.fromkeys(wanted or known))
