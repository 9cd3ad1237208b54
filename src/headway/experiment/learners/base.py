"""What every kind of model keeps to: it begins, is fitted, acts, and says what it has learned."""

import abc
from collections.abc import Callable, Generator, Iterable, Sequence
from typing import Any, ClassVar, NamedTuple, Self

import numpy as np
from jaxtyping import Float, PRNGKeyArray

from headway.config import Config, override
from headway.data import Episodes, Samples, Trajectory
from headway.models.fitting import EpochStats, FitData, FitSetup, make_data
from headway.models.multi_headed import Statistics
from headway.planning.agent import Agent
from headway.task import Task
from headway.training.collect import Environments
from headway.training.diagnostics import prediction_error
from headway.training.methods import told_sim_params


class Learned(NamedTuple):
    """What a checkpoint holds; pytrees of arrays."""

    fit: Any
    """Weights and the optimiser's moments, as an epoch takes and returns them."""
    statistics: Any
    """Normalisers of the data that they were fitted to."""


Epochs = Generator[tuple[Any, EpochStats], None, None]


class Fit(NamedTuple):
    """A fit to all data of an iteration, ready to run."""

    statistics: Any
    """The normalisers, renewed."""
    epochs: Callable[[Any, int], Epochs]
    """Goes on from a fit state with some epoch; yields the state after each, and its averages."""


class Learner(abc.ABC):
    """One kind of model, for one run.

    Args:
        config: Settings of the run.
        task: Its Task.
        episode_length: Steps of an episode.
    """

    learns: ClassVar[bool] = True
    """Whether anything is fitted; without, a run only tests."""

    def __init__(self, config: Config, task: Task, episode_length: int):
        self.config = config
        self.task = task
        self.episode_length = episode_length

    @property
    def setup(self) -> FitSetup:
        """Constants of the compiled epoch."""
        return FitSetup(self.task, self.config.fitting, self.config.model.history_length)

    @abc.abstractmethod
    def initial(self, key: PRNGKeyArray) -> Learned:
        """Draw what is not trained yet."""

    @abc.abstractmethod
    def fit(self, trajectories: list[Trajectory], iteration: int, key: PRNGKeyArray) -> Fit:
        """Prepare to fit everything collected so far; the key alone decides what is drawn."""

    @abc.abstractmethod
    def agent(
        self,
        learned: Learned,
        environments: Environments | None = None,
        trajectories: Sequence[Trajectory] = (),
    ) -> Agent:
        """The agent that acts with what was learned.

        Args:
            learned: What was learned.
            environments: Where it acts, if that is known; only the simulator asks.
            trajectories: What it was learned from; only heads that keep learning ask.
        """

    def pad(self, trajectories: list[Trajectory]) -> Episodes:
        """Lay all data out, padded to their size at the end of the run: compiled once."""
        collection, names = self.config.collection, told_sim_params(self.config)
        of_run = collection.num_iterations * collection.num_episodes
        capacity = max(of_run, len(trajectories))
        return Episodes.pad(trajectories, capacity, self.episode_length, names)

    def lay_out(
        self,
        trajectories: list[Trajectory],
        statistics: Statistics,
        num_members: int,
        key: PRNGKeyArray,
    ) -> FitData:
        """Bring together what an epoch reads.

        Args:
            trajectories: All data so far.
            statistics: Normalisers fitted to them.
            num_members: Networks in the ensemble.
            key: Draws the bootstrap samples.
        """
        fitting, episodes = self.config.fitting, self.pad(trajectories)
        samples = Samples.table(
            [len(trajectory) for trajectory in trajectories],
            fitting.future_length,
            capacity=episodes.action[..., 0].size * fitting.future_length,
            drop_first=fitting.drop_first_anchor,
        )
        return make_data(episodes, samples, statistics, fitting, num_members=num_members, key=key)

    def frozen(self, learned: Learned) -> Agent:
        """The agent with the model as it was fitted; nothing of it learns while acting."""
        return self.agent(learned)

    def slower(self, factor: float) -> Self:
        """The same, but learning with smaller steps."""
        rate = max(1e-12, factor * self.config.fitting.learning_rate)
        config = override(self.config, {"fitting.learning_rate": rate})
        return type(self)(config, self.task, self.episode_length)

    def head_losses(
        self, learned: Learned, trajectories: list[Trajectory]
    ) -> Iterable[Float[np.ndarray, "member head time"]]:
        """Loss of every head along each trajectory; none where there are no heads."""
        del learned, trajectories
        return ()

    def head_shares(
        self, learned: Learned, trajectories: list[Trajectory]
    ) -> Sequence[dict[str, Any]]:
        """Rows of `assignments.csv`, without the iteration; none where there are no heads."""
        del learned, trajectories
        return ()

    def prediction_error(
        self, learned: Learned, trajectories: list[Trajectory], key: PRNGKeyArray
    ) -> Float[np.ndarray, " step"]:
        """Error by imagined step over some episodes; empty where nothing was learned."""
        if not self.learns:
            return np.zeros(0)
        # The same moments for every kind of model, whatever it remembers.
        planner = self.config.planner
        first = max(self.config.model.history_length, planner.selection_length)
        return prediction_error(self.frozen(learned), trajectories, first=first, key=key)
