"""Ensembles of multi-headed networks: T-MCL and all that is expressed by its settings."""

import dataclasses
import itertools
from collections.abc import Iterable, Sequence
from contextlib import closing
from typing import Any

import jax
import numpy as np
from jaxtyping import Float, PRNGKeyArray

from headway.data import Episodes, Trajectory
from headway.experiment.blocks import BlockedData, Layout, fit_blocks
from headway.experiment.diagnostics import head_shares, prediction_error
from headway.experiment.learners.base import Epochs, Fit, Learned, Learner
from headway.experiment.methods import told_sim_params
from headway.experiment.rollouts import Arena
from headway.models.dynamics import MultiHeadDynamics, Statistics
from headway.models.fitting import FitSetup, FitState, episode_losses
from headway.planning.agent import Agent
from headway.planning.last_layer.prior import fit_prior


class MultiHeaded(Learner):
    """`MultiHeadDynamics`, fitted block by block; heads are chosen while acting."""

    @property
    def setup(self) -> FitSetup:
        """What fixes the compiled epoch."""
        return FitSetup(self.task, self.config.fitting, self.config.model.history_length)

    @property
    def layout(self) -> Layout:
        """Sizes of a block."""
        return Layout.of(self.config, self.episode_length)

    def initial(self, key: PRNGKeyArray) -> Learned:
        """See `Learner.initial`."""
        config, names = self.config.model, told_sim_params(self.config)
        model = MultiHeadDynamics.init(config, self.task, sim_param_names=names, key=key)
        statistics = Statistics.identity(self.task, config.history_length, names)
        return Learned(self.setup.init(model), statistics)

    def fit(self, trajectories: list[Trajectory], iteration: int, key: PRNGKeyArray) -> Fit:
        """See `Learner.fit`."""
        model, fitting = self.config.model, self.config.fitting
        data_key, epoch_key = jax.random.split(key)
        names = self.layout.sim_param_names
        statistics = Statistics.fit(self.task, trajectories, model.history_length, names)
        data = BlockedData(
            trajectories, self.layout, statistics, self.setup, model.num_members, data_key
        )
        independent = (
            iteration < fitting.warmup_iterations
            or fitting.oracle == "independent"
            or model.num_heads == 1
        )

        def epochs(state: FitState, first: int) -> Epochs:
            with closing(data.stream(fitting.epochs, epoch_key, first=first)) as blocks:
                for _ in range(first, fitting.epochs):
                    of_epoch = itertools.islice(blocks, data.num_blocks)
                    state, stats = fit_blocks(state, self.setup, of_epoch, independent=independent)
                    yield state, stats

        return Fit(statistics, epochs)

    def agent(
        self,
        learned: Learned,
        arena: Arena | None = None,
        trajectories: Sequence[Trajectory] = (),
    ) -> Agent:
        """See `Learner.agent`."""
        del arena
        model, statistics = learned.fit.model, learned.statistics
        planner, history_length = self.config.planner, self.config.model.history_length
        prior = None
        if planner.adaptation != "none":
            prior = fit_prior(
                model,
                self.task,
                statistics,
                trajectories,
                history_length=history_length,
                horizon=planner.horizon,
            )
        return Agent(model, statistics, self.task, planner, history_length, prior)

    def frozen(self, learned: Learned) -> Agent:
        """The agent whose heads stay as they were fitted."""
        planner = dataclasses.replace(self.config.planner, adaptation="none")
        model, length = learned.fit.model, self.config.model.history_length
        return Agent(model, learned.statistics, self.task, planner, length)

    def head_losses(
        self, learned: Learned, trajectories: list[Trajectory]
    ) -> Iterable[Float[np.ndarray, "member head time"]]:
        """See `Learner.head_losses`; one trajectory at a time."""
        names = self.layout.sim_param_names
        for trajectory in trajectories:
            episode = Episodes.pad([trajectory], 1, self.episode_length, names)
            losses = episode_losses(learned.fit.model, self.setup, episode, 0, learned.statistics)
            yield np.asarray(losses.forward)[..., : len(trajectory)]

    def head_shares(
        self, learned: Learned, trajectories: list[Trajectory]
    ) -> Sequence[dict[str, Any]]:
        """See `Learner.head_shares`."""
        return head_shares(self.frozen(learned), self.setup, self.layout.in_order(trajectories))

    def prediction_error(
        self, learned: Learned, trajectories: list[Trajectory], key: PRNGKeyArray
    ) -> Float[np.ndarray, " step"]:
        """See `Learner.prediction_error`."""
        return prediction_error(self.frozen(learned), trajectories, key=key)
