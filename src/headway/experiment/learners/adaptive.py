"""Models that change while they act: GrBAL's and ReBAL's."""

import abc
from collections.abc import Sequence
from typing import Any

import jax
from jaxtyping import PRNGKeyArray

from headway.config import GradientAdaptedConfig
from headway.data import Trajectory
from headway.experiment.learners.base import Epochs, Fit, Learned, Learner
from headway.models.base import Model
from headway.models.fitting import EpochStats, FitData, FitState
from headway.models.grbal import GrBAL, ReluNet, meta_epoch
from headway.models.multi_headed import Statistics
from headway.models.rebal import ReBAL, RecurrentNet, recurrent_epoch
from headway.planning.agent import Agent
from headway.training.collect import Environments


class Adaptive(Learner):
    """One network that is fitted by a procedure of its own to the data that T-MCL has."""

    @abc.abstractmethod
    def draw_net(self, key: PRNGKeyArray) -> Any:
        """Initial weights."""

    @abc.abstractmethod
    def fit_epoch(
        self, state: FitState, data: FitData, key: PRNGKeyArray
    ) -> tuple[FitState, EpochStats]:
        """Go once through the data."""

    @abc.abstractmethod
    def acting_model(self, learned: Learned) -> Model:
        """The model as it acts."""

    def initial(self, key: PRNGKeyArray) -> Learned:
        """See `Learner.initial`."""
        state = FitState.new(self.draw_net(key))
        return Learned(state, Statistics.identity(self.task, self.config.model.history_length))

    def fit(self, trajectories: list[Trajectory], iteration: int, key: PRNGKeyArray) -> Fit:
        """See `Learner.fit`."""
        del iteration
        statistics = Statistics.fit(self.task, trajectories, self.config.model.history_length)
        data = self.lay_out(trajectories, statistics, num_members=1, key=key)

        def epochs(state: FitState, first: int) -> Epochs:
            for epoch in range(first, self.config.fitting.epochs):
                state, stats = self.fit_epoch(state, data, jax.random.fold_in(key, epoch))
                yield state, jax.device_get(stats)

        return Fit(statistics, epochs)

    def agent(
        self,
        learned: Learned,
        environments: Environments | None = None,
        trajectories: Sequence[Trajectory] = (),
    ) -> Agent:
        """See `Learner.agent`."""
        del environments, trajectories
        return Agent(self.acting_model(learned), self.task, self.config.planner)


class GradientAdaptation(Adaptive):
    """GrBAL: weights from which one gradient step adapts.

    Source: learning_to_adapt, `meta_mlp_dynamics.py`.
    """

    @property
    def inner_step(self) -> tuple[int, float]:
        """Transitions that a gradient step adapts to, and its size."""
        model = self.config.model
        assert isinstance(model, GradientAdaptedConfig)
        return model.adaptation_length, model.adaptation_rate

    def draw_net(self, key: PRNGKeyArray) -> ReluNet:
        """See `Adaptive.draw_net`."""
        return ReluNet.init(self.config.model, self.task, key=key)

    def fit_epoch(
        self, state: FitState, data: FitData, key: PRNGKeyArray
    ) -> tuple[FitState, EpochStats]:
        """See `Adaptive.fit_epoch`."""
        length, rate = self.inner_step
        return meta_epoch(state, self.setup, data, length=length, rate=rate, key=key)

    def acting_model(self, learned: Learned) -> GrBAL:
        """See `Adaptive.acting_model`."""
        return GrBAL(learned.fit.model, learned.statistics, self.task, *self.inner_step)


class Recurrence(Adaptive):
    """ReBAL: a recurrent network (learning_to_adapt, `rnn_dynamics.py`)."""

    def draw_net(self, key: PRNGKeyArray) -> RecurrentNet:
        """See `Adaptive.draw_net`."""
        return RecurrentNet.init(self.config.model, self.task, key=key)

    def fit_epoch(
        self, state: FitState, data: FitData, key: PRNGKeyArray
    ) -> tuple[FitState, EpochStats]:
        """See `Adaptive.fit_epoch`."""
        return recurrent_epoch(state, self.setup, data, key=key)

    def acting_model(self, learned: Learned) -> ReBAL:
        """See `Adaptive.acting_model`."""
        return ReBAL(learned.fit.model, learned.statistics, self.task)
