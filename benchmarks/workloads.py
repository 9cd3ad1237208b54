"""What is timed: agents and fits at the paper's HalfCheetah sizes, and their operations."""

from typing import Any

import jax
import numpy as np

from headway.config import FittingConfig, MultiHeadedConfig, PlannerConfig
from headway.data import Episodes, Samples, Trajectory
from headway.models.fitting import FitData, FitSetup, FitState, make_data
from headway.models.last_layer import Prior
from headway.models.multi_headed import MultiHeadModel, MultiHeadNet
from headway.models.statistics import Statistics
from headway.planning.agent import Agent, AgentState
from headway.task import Task, env_spec

EPISODE_LENGTH = 200


def make_agent(
    num_envs: int,
    model: MultiHeadedConfig | None = None,
    planner: PlannerConfig | None = None,
    prior: Prior | None = None,
) -> tuple[Agent, AgentState, jax.Array]:
    """An untrained agent, its first state, and what it sees; the paper's settings by default."""
    model, planner = model or MultiHeadedConfig(), planner or PlannerConfig()
    task = env_spec("half-cheetah").make_task()
    dynamics = MultiHeadNet.init(model, task, key=jax.random.key(0))
    statistics = Statistics.identity(task, model.history_length)
    acting = MultiHeadModel(dynamics, statistics, task, planner, model.history_length, prior)
    agent = Agent(acting, task, planner)
    obs = 0.1 * jax.random.normal(jax.random.key(1), (num_envs, task.obs_size))
    return agent, agent.init(num_envs, key=jax.random.key(2)), obs


def planners() -> dict[str, PlannerConfig]:
    """The paper's planner in each precision of matrix products."""
    return {"float32": PlannerConfig(), "bfloat16": PlannerConfig(precision="bfloat16")}


def make_trajectories(task: Task, num_episodes: int, length: int) -> list[Trajectory]:
    """Random walks with the task's sizes."""
    rng = np.random.default_rng(0)
    walks = rng.normal(0, 0.1, (num_episodes, length + 1, task.obs_size)).cumsum(1)
    actions = rng.uniform(-1, 1, (num_episodes, length, task.action_size))
    return [
        Trajectory(obs.astype(np.float32), action.astype(np.float32), np.zeros(length), {})
        for obs, action in zip(walks, actions, strict=True)
    ]


def make_fit(
    num_episodes: int, capacity: int, model: MultiHeadedConfig, fitting: FittingConfig
) -> tuple[FitState, FitSetup, FitData]:
    """A new model, and episodes of HalfCheetah's size on the device.

    Args:
        num_episodes: Episodes of `EPISODE_LENGTH` steps.
        capacity: Episodes of a whole run; the arrays have this size from the start.
        model: Settings of the model.
        fitting: Settings of the fit.
    """
    task = env_spec("half-cheetah").make_task()
    dynamics = MultiHeadNet.init(model, task, key=jax.random.key(0))
    trajectories = make_trajectories(task, num_episodes, EPISODE_LENGTH)
    setup = FitSetup(task, fitting, model.history_length)
    samples = Samples.table(
        [EPISODE_LENGTH] * num_episodes,
        fitting.future_length,
        capacity * EPISODE_LENGTH * fitting.future_length,
    )
    data = make_data(
        Episodes.pad(trajectories, capacity, EPISODE_LENGTH),
        samples,
        Statistics.fit(task, trajectories, model.history_length),
        fitting,
        num_members=model.num_members,
        key=jax.random.key(1),
    )
    return FitState.new(dynamics), setup, data


def update_flop(model: MultiHeadNet, batch_size: int) -> float:
    """Operations of the matrix products of one update: forwards, and twice that backwards."""
    weights: list[Any] = [leaf for leaf in jax.tree.leaves(model) if leaf.ndim >= 3]
    return 6.0 * batch_size * sum(weight.size for weight in weights)
