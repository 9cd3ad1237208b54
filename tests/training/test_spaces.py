"""Environments with other actions than float32 numbers, and Tasks that state no sizes."""

import itertools

import gymnasium
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from gymnasium.spaces import Box, Discrete, MultiBinary, MultiDiscrete, Tuple

import headway
from headway import task
from headway.config import PlannerConfig
from headway.envs.vector import read_spaces
from headway.errors import BadEnvironmentError, RunError
from headway.planning.agent import Agent
from headway.training.environments import Environments

OBS = Box(-np.inf, np.inf, (3,), np.float64)
SPACES = {
    "discrete": Discrete(3, start=-1),
    "multi-discrete": MultiDiscrete([2, 4], start=[5, 0]),
    "multi-binary": MultiBinary((2, 2)),
    "integers": Box(np.array([-2, 0]), np.array([1, 7]), dtype=np.int16),
    "float64": Box(-0.1, 1 / 3, (2, 1), np.float64),
}
SMALL = {
    "collection.num_episodes": 1,
    "collection.episode_length": 6,
    "collection.check": False,  # it pays 0, whatever the Task says
    "fitting.epochs": 1,
}


class Push(gymnasium.Env):
    """Random numbers; it takes only what its action space contains."""

    def __init__(self, obs=OBS, action=SPACES["discrete"]):
        self.observation_space, self.action_space = obs, action

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        return self.np_random.normal(size=3), {}

    def step(self, action):
        assert self.action_space.contains(action), repr(action)
        return self.np_random.normal(size=3), 0.0, False, False, {}


class PushTask(headway.Task):
    def reward(self, obs, action, next_obs):
        return -jnp.square(next_obs[..., 0]) + 0.0 * action.sum(-1)


class StatingTask(PushTask):
    obs_size, action_size, action_low, action_high = 3, 1, (-1.0,), (-1.0,)


@pytest.fixture
def push():
    """Registers the environment with some spaces; may be called again."""

    def make(make_task=PushTask, **spaces):
        gymnasium.registry.pop("own/Push-v0", None)
        gymnasium.register("own/Push-v0", Push, kwargs=spaces)
        sets = headway.SimParamSets({"gain": [1.0]})
        own = {"name": "push", "env_id": "own/Push-v0", "make_task": make_task}
        headway.register(headway.EnvSpec(**own, sim_params=sets, episode_length=6))

    yield make
    del gymnasium.registry["own/Push-v0"], task._registered["push"]


@pytest.mark.parametrize("space", SPACES.values(), ids=SPACES)
def test_actions_are_the_nearest_that_the_space_contains(space):
    own = PushTask(told_spaces=read_spaces(OBS, space))
    rng, size = np.random.default_rng(0), own.action_size
    draws = rng.uniform(-1, 1, (2000, size)).astype(np.float32)
    taken = [task.env_action(own, draw) for draw in draws]
    assert all(map(space.contains, taken))
    flat = np.reshape(taken, (len(draws), -1))
    if own.spaces.action_kind == "box":
        ends = [task.env_action(own, np.full(size, end, np.float32)) for end in (-1, 1)]
        np.testing.assert_array_equal(ends, [space.low, space.high])  # to the last bit
        np.testing.assert_allclose(task.scaled_action(own, flat), draws, atol=1e-6)
        return
    bounds = zip(own.action_low, own.action_high, strict=True)
    every = np.array([*itertools.product(*(np.arange(low, high + 1) for low, high in bounds))])
    scaled = task.scaled_action(own, every)
    nearest = np.square(draws[:, None] - scaled).sum(-1).argmin(1)
    np.testing.assert_array_equal(flat, every[nearest])
    np.testing.assert_allclose(own.project_action(jnp.asarray(draws)), scaled[nearest], atol=1e-6)
    np.testing.assert_allclose(own.scale_action(jnp.asarray(scaled)), every, atol=1e-5)
    if own.spaces.action_kind == "categories":  # one that was measured may lie beyond
        np.testing.assert_array_equal(task.scaled_action(own, every[-1:] + 1.0), scaled[-1:])
    assert np.bincount(nearest, minlength=len(every)).min() > 0.6 * len(draws) / len(every)


@pytest.mark.parametrize("optimizer", ["cem", "icem", "random-shooting"])
def test_every_optimizer_plans_the_best_category(optimizer):
    own = PushTask(told_spaces=read_spaces(OBS, Discrete(3)))
    planner = PlannerConfig({"name": optimizer}, horizon=2, num_particles=1)
    pushes = np.float32([-0.6, 0.1, 0.9])  # the best one is no end of an order
    model = headway.FunctionModel(pushes, lambda p, obs, a: 0 * obs + ((a + 1) / 2 @ p)[..., None])
    agent = Agent(model, own, planner)
    _, decision = agent.act(agent.init(1, key=jax.random.key(0)), np.zeros((1, 3)))
    np.testing.assert_array_equal(decision.action, [[-1.0, 1.0, -1.0]])


@pytest.mark.filterwarnings("ignore:.*was trained on push as it was before")
@pytest.mark.parametrize(
    ("name", "method"),
    [*zip(SPACES, ["tmcl", "random", "rebal", "grbal", "pets"], strict=True)],
)
def test_a_run_acts_in_every_space_and_its_controller_needs_no_environment(
    name, method, push, tmp_path
):
    push(action=SPACES[name])
    run = headway.train("push", method=method, preset="smoke", run_dir=tmp_path, settings=SMALL)
    assert run.config.spaces == read_spaces(OBS, SPACES[name])
    push(action=Discrete(7))
    with pytest.raises(BadEnvironmentError, match=r"other spaces than its run \(spaces.action_"):
        headway.evaluate(tmp_path)
    with pytest.raises(RunError, match=r"other settings \(spaces.action_"):
        headway.train("push", method=method, preset="smoke", run_dir=tmp_path, settings=SMALL)
    controller = headway.load(tmp_path, deadline_ms=None if method == "random" else 6e4)
    applied, seen = SPACES[name].sample(), [np.zeros(3), np.ones(3)]
    if method != "random":
        seen.append(np.full(3, np.nan))  # it holds its plan
    for obs in seen:
        action = controller.act(obs, applied_action=applied)
        assert SPACES[name].contains(action)
        assert type(action) is type(applied)


REFUSED = [
    (PushTask, {"obs": Box(0, 255, (8, 8, 3), np.uint8)}, r"observation space .*one row"),
    (PushTask, {"action": Tuple([Discrete(2)])}, "space Tuple.*TransformAction"),
    (PushTask, {"action": Box(-np.inf, 1, (1,))}, "action_low .*-inf.* allowed: finite"),
    (PushTask, {"action": Box(-(2**60), 2**60, (1,), np.int64)}, "action_low .*allowed: finite"),
    (StatingTask, {"action": Box(-1, 1, (1,))}, "action_low .*allowed: finite"),
    (StatingTask, {}, r"\(3, 1, 1, 1\) as .* has \(3, 3, 1, 1\)"),
]


@pytest.mark.parametrize(("make_task", "spaces", "says"), REFUSED)
def test_what_cannot_be_planned_in_is_said_in_one_line(make_task, spaces, says, push):
    push(make_task, **spaces)
    with pytest.raises(BadEnvironmentError, match=says) as caught:
        Environments.make(headway.make_config("push", preset="smoke"))
    assert "\n" not in str(caught.value)
