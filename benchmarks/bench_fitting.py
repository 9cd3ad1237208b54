"""One fitted epoch of the paper's model: forward and backward nets, 256 samples per member."""

import jax
import numpy as np

from headway.config import FittingConfig, ModelConfig
from headway.data import Episodes, Samples, Trajectory
from headway.models.dynamics import MultiHeadDynamics, Statistics
from headway.models.fitting import FitData, FitSetup, FitState, fit_epoch, make_data
from headway.tasks.base import Task
from headway.tasks.catalog import env_spec

MODEL = ModelConfig()
FITTING = FittingConfig()
NUM_EPISODES = 10
EPISODE_LENGTH = 200
CAPACITY = 100  # episodes of a whole run; the arrays have this size from the start


def make_trajectories(task: Task) -> list[Trajectory]:
    """Random walks of HalfCheetah's size."""
    rng = np.random.default_rng(0)
    walks = rng.normal(0, 0.1, (NUM_EPISODES, EPISODE_LENGTH + 1, task.obs_size)).cumsum(1)
    actions = rng.uniform(-1, 1, (NUM_EPISODES, EPISODE_LENGTH, task.action_size))
    return [
        Trajectory(obs.astype(np.float32), action.astype(np.float32), np.zeros(EPISODE_LENGTH), {})
        for obs, action in zip(walks, actions, strict=True)
    ]


def make_fit() -> tuple[FitState, FitSetup, FitData]:
    """A new model and ten episodes, on the device."""
    task = env_spec("half-cheetah").make_task()
    model = MultiHeadDynamics.init(MODEL, task, key=jax.random.key(0))
    trajectories = make_trajectories(task)
    setup = FitSetup(task, FITTING, MODEL.history_length)
    samples = Samples.table(
        [EPISODE_LENGTH] * NUM_EPISODES,
        FITTING.future_length,
        CAPACITY * EPISODE_LENGTH * FITTING.future_length,
    )
    data = make_data(
        Episodes.pad(trajectories, CAPACITY, EPISODE_LENGTH),
        samples,
        Statistics.fit(task, trajectories, MODEL.history_length),
        FITTING,
        num_members=MODEL.num_members,
        key=jax.random.key(1),
    )
    return setup.init(model), setup, data


def update_flop(model: MultiHeadDynamics) -> float:
    """Operations of the matrix products of one update: forwards, and twice that backwards."""
    weights = [leaf for leaf in jax.tree.leaves(model) if leaf.ndim >= 3]
    return 6.0 * FITTING.batch_size * sum(weight.size for weight in weights)


def test_epoch(timed, report):
    state, setup, data = make_fit()
    key = jax.random.key(2)
    _, stats = fit_epoch(state, setup, data, independent=False, key=key)
    updates = int(stats.updates)
    timing = timed(lambda: fit_epoch(state, setup, data, independent=False, key=key), rounds=3)
    each = timing.seconds / updates
    report.add(f"fitted epoch of {updates} updates, heads assigned", timing.seconds, "s")
    report.add(
        f"  one update of {MODEL.num_members} x {FITTING.batch_size}: its share",
        1e3 * each,
        "ms",
        **timing.ratio(update_flop(state.model), each),
    )
