"""What the growth curves vary, and the work that is timed at each point. Small networks."""

import dataclasses
from collections.abc import Callable
from typing import Any

import jax
from workloads import EPISODE_LENGTH, make_agent, make_fit, make_trajectories

from headway.config import CEMConfig, FittingConfig, MultiHeadedConfig, PlannerConfig
from headway.data import Episodes, Samples
from headway.models.compilation import jit_networks
from headway.models.fitting import assign_segments, fit_epoch, make_data
from headway.models.multi_headed import Statistics
from headway.task import env_spec

MODEL = MultiHeadedConfig(
    num_members=2, hidden_sizes=(64, 64), context_hidden_sizes=(32,), backward_net=False
)
PLANNER = PlannerConfig(
    horizon=10,
    num_candidates=100,
    optimizer=CEMConfig(num_elites=25),
    num_iterations=2,
    num_particles=4,
)
FITTING = FittingConfig(future_length=1)
NUM_ENVS = 8

Work = Callable[[], Any]


@dataclasses.dataclass(frozen=True)
class Axis:
    """One curve: what grows, through which sizes, and the work at a size."""

    name: str
    what: str
    unit: str
    sizes: tuple[int, ...]
    work: Callable[[int], Work]


def plan(num_envs: int = NUM_ENVS, model: MultiHeadedConfig = MODEL, **planner: Any) -> Work:
    """One plan of the small planner with some settings changed."""
    settings = dataclasses.replace(PLANNER, **planner)
    agent, state, obs = make_agent(num_envs, model, settings)
    return lambda: agent.act(state, obs)


def plan_of_members(members: int) -> Work:
    """One plan; every member has two particles, so the work grows with the members."""
    model = dataclasses.replace(MODEL, num_members=members)
    return plan(model=model, num_particles=2 * members)


def epoch(transitions: int = 10_000, members: int = MODEL.num_members) -> Work:
    """One epoch over a data set, heads assigned."""
    model = dataclasses.replace(MODEL, num_members=members)
    episodes = transitions // EPISODE_LENGTH
    state, setup, data = make_fit(episodes, episodes, model, FITTING)
    key = jax.random.key(2)
    return lambda: fit_epoch(state, setup, data, independent=False, key=key)


def assignment(transitions: int) -> Work:
    """The winning head of every segment of a data set."""
    episodes = transitions // EPISODE_LENGTH
    state, setup, data = make_fit(episodes, episodes, MODEL, FITTING)
    assign = jit_networks(assign_segments)
    return lambda: assign(state.model, setup, data.episodes, data.statistics)


def preparation(transitions: int) -> Work:
    """All that is done with a data set before its first epoch."""
    task = env_spec("half-cheetah").make_task()
    episodes = transitions // EPISODE_LENGTH
    trajectories = make_trajectories(task, episodes, EPISODE_LENGTH)

    def prepare() -> Any:
        return make_data(
            Episodes.pad(trajectories, episodes, EPISODE_LENGTH),
            Samples.table([EPISODE_LENGTH] * episodes, FITTING.future_length, transitions),
            Statistics.fit(task, trajectories, MODEL.history_length),
            FITTING,
            num_members=MODEL.num_members,
            key=jax.random.key(1),
        )

    return prepare


_TRANSITIONS = (1_000, 10_000, 30_000, 100_000, 300_000, 1_000_000)
_MEMBERS = (1, 2, 4, 6, 8, 10)

AXES = {
    axis.name: axis
    for axis in (
        Axis("environments", "plan", "environments", (1, 4, 16, 32, 64, 128, 256), plan),
        Axis(
            "candidates",
            "plan",
            "candidates",
            (25, 50, 100, 200, 400, 800, 1600),
            lambda size: plan(num_candidates=size, num_elites=size // 5),
        ),
        Axis("horizon", "plan", "steps", (5, 10, 20, 30, 40, 60), lambda size: plan(horizon=size)),
        Axis("members", "plan", "members", _MEMBERS, plan_of_members),
        Axis("members-epoch", "epoch", "members", _MEMBERS, lambda size: epoch(members=size)),
        Axis("data-epoch", "epoch", "transitions", _TRANSITIONS, epoch),
        Axis("data-assignment", "head assignment", "transitions", _TRANSITIONS, assignment),
        Axis("data-preparation", "preparing data", "transitions", _TRANSITIONS, preparation),
    )
}
