"""Ensembles of multi-headed networks: T-MCL and all that is expressed by its settings."""

import dataclasses
from collections.abc import Iterable, Sequence
from typing import Any

import jax
import numpy as np
from jaxtyping import Float, PRNGKeyArray

from headway.data import Episodes, Trajectory
from headway.experiment.learners.base import Epochs, Fit, Learned, Learner
from headway.models.acting import MultiHeadModel
from headway.models.fitting import FitState, episode_losses, fit_epoch
from headway.models.last_layer_prior import fit_prior
from headway.models.multi_headed import MultiHeadDynamics, Statistics
from headway.planning.agent import Agent
from headway.training.collect import Environments
from headway.training.diagnostics import head_shares
from headway.training.methods import told_sim_params


class MultiHeaded(Learner):
    """`MultiHeadDynamics`; heads are chosen while acting."""

    def initial(self, key: PRNGKeyArray) -> Learned:
        """See `Learner.initial`."""
        config, names = self.config.model, told_sim_params(self.config)
        model = MultiHeadDynamics.init(config, self.task, sim_param_names=names, key=key)
        statistics = Statistics.identity(self.task, config.history_length, names)
        return Learned(FitState.new(model), statistics)

    def fit(self, trajectories: list[Trajectory], iteration: int, key: PRNGKeyArray) -> Fit:
        """See `Learner.fit`."""
        model, fitting = self.config.model, self.config.fitting
        data_key, epoch_key = jax.random.split(key)
        names = told_sim_params(self.config)
        statistics = Statistics.fit(self.task, trajectories, model.history_length, names)
        data = self.lay_out(trajectories, statistics, model.num_members, data_key)
        independent = (
            iteration < fitting.warmup_iterations
            or fitting.oracle == "independent"
            or model.num_heads == 1
        )

        def epochs(state: FitState, first: int) -> Epochs:
            for epoch in range(first, fitting.epochs):
                key = jax.random.fold_in(epoch_key, epoch)
                state, stats = fit_epoch(state, self.setup, data, independent=independent, key=key)
                yield state, jax.device_get(stats)

        return Fit(statistics, epochs)

    def agent(
        self,
        learned: Learned,
        environments: Environments | None = None,
        trajectories: Sequence[Trajectory] = (),
    ) -> Agent:
        """See `Learner.agent`."""
        del environments
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
        acting = MultiHeadModel(model, statistics, self.task, planner, history_length, prior)
        return Agent(acting, self.task, planner)

    def frozen(self, learned: Learned) -> Agent:
        """See `Learner.frozen`."""
        planner = dataclasses.replace(self.config.planner, adaptation="none")
        model, length = learned.fit.model, self.config.model.history_length
        acting = MultiHeadModel(model, learned.statistics, self.task, planner, length)
        return Agent(acting, self.task, planner)

    def head_losses(
        self, learned: Learned, trajectories: list[Trajectory]
    ) -> Iterable[Float[np.ndarray, "member head time"]]:
        """See `Learner.head_losses`; one trajectory at a time."""
        names = told_sim_params(self.config)
        for trajectory in trajectories:
            episode = Episodes.pad([trajectory], 1, self.episode_length, names)
            losses = episode_losses(learned.fit.model, self.setup, episode, 0, learned.statistics)
            yield np.asarray(losses.forward)[..., : len(trajectory)]

    def head_shares(
        self, learned: Learned, trajectories: list[Trajectory]
    ) -> Sequence[dict[str, Any]]:
        """See `Learner.head_shares`."""
        model, statistics, episodes = learned.fit.model, learned.statistics, self.pad(trajectories)
        return head_shares(model, statistics, self.setup, trajectories, episodes)
