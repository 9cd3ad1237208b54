"""Joining what was learned with the settings of the planner."""

from collections.abc import Sequence

from headway.config import Config
from headway.data import Trajectory
from headway.models.dynamics import MultiHeadDynamics, Statistics
from headway.planning.agent import Agent
from headway.planning.prior import fit_prior
from headway.tasks.base import Task


def make_agent(
    config: Config,
    task: Task,
    model: MultiHeadDynamics,
    statistics: Statistics,
    trajectories: Sequence[Trajectory],
) -> Agent:
    """An agent that plans as the settings say.

    Args:
        config: All settings.
        task: The Task.
        model: The networks.
        statistics: Their normalisers.
        trajectories: What they were fitted to; heads that keep learning start from it.
    """
    planner, history_length = config.planner, config.model.history_length
    prior = None
    if planner.adaptation != "none":
        prior = fit_prior(
            model,
            task,
            statistics,
            trajectories,
            history_length=history_length,
            head_noise=planner.adaptation_noise == "heads",
            rank=planner.adaptation_prior,
        )
    return Agent(model, statistics, task, planner, history_length, prior)
