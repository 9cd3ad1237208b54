"""Environments that nobody registered, and episodes that end early."""

import warnings

import gymnasium
import numpy as np
import pytest

import headway
import runs
from headway import task
from headway.errors import HeadwayError, UnknownNameError
from headway.task import BUILT_IN
from headway.training import run as run_module
from headway.training.train import train_run

SIM_PARAMS = {"train": {"push": [0.5, 1.0]}, "unseen": {"far": {"push": [2.0]}}}


class Falling(gymnasium.Env):
    """A number that is pushed; an episode ends after `ends` steps."""

    observation_space = gymnasium.spaces.Box(-np.inf, np.inf, (1,), np.float64)
    action_space = gymnasium.spaces.Box(-1, 1, (1,), np.float32)

    def __init__(self, ends=6):
        self.ends = ends

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.push, self.steps = (options or {}).get("sim_params", {}).get("push", 1.0), 0
        self.state = self.np_random.normal(size=1)
        return self.state.copy(), {"sim_params": {"push": self.push}}

    def step(self, action):
        self.state, self.steps = self.state + self.push * np.asarray(action), self.steps + 1
        return self.state.copy(), float(self.state[0]), False, self.steps == self.ends, {}


class FallingTask(headway.Task):
    def reward(self, obs, action, next_obs):
        return next_obs[..., 0]


SPEC = headway.EnvSpec(
    env_id=Falling,
    make_task=FallingTask,
    sim_params=headway.SimParamSets(**SIM_PARAMS),
    episode_length=20,
)


@pytest.fixture(autouse=True)
def registry(monkeypatch):
    monkeypatch.setattr(task, "_registered", {})


@pytest.mark.parametrize("make_task", [FallingTask, FallingTask()])
def test_an_environment_and_a_task_are_enough_and_another_process_is_told_what_it_needs(
    make_task, tmp_path
):
    given = {"env": Falling, "task": make_task, "sim_params": SIM_PARAMS, "method": "random"}
    given |= {"preset": "smoke", "run_dir": tmp_path / "run"}
    run = headway.train(**given)
    assert run.config.env == "Falling"
    assert {row.group for row in run.evaluation} == {"train", "far"}
    assert len(headway.evaluate(run.path)) == len(headway.train(**given).evaluation)
    task._registered.clear()
    with pytest.raises(UnknownNameError, match=r"^[^\n]*headway.register") as caught:
        headway.load(run.path)
    assert "\n" not in str(caught.value)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        headway.register(headway.EnvSpec(**{**vars(SPEC), "episode_length": 0}))
        assert headway.load(run.path).act(np.zeros(1)).shape == (1,)


def test_a_spec_that_a_module_holds_is_named_so_that_any_process_finds_it(tmp_path):
    named = {"method": "random", "preset": "smoke", "run_dir": tmp_path / "run"}
    run = headway.train(SPEC, **named)
    assert run.config.env == f"{__name__}:SPEC"
    assert not task._registered
    assert len(headway.evaluate(run.path)) == len(run.evaluation)
    other = {"train": {"push": [3.0]}}
    run = headway.train(SPEC, sim_params=other, **named | {"run_dir": tmp_path / "other"})
    assert {row.sim_params["push"] for row in run.evaluation} == {3.0}


@pytest.mark.parametrize(
    ("given", "says"),
    [
        ({"env": SPEC, "task": FallingTask}, "an EnvSpec has a Task"),
        ({"env": Falling, "task": FallingTask}, "sim_params are missing, or task"),
        ({"env": Falling}, "sim_params are missing, or task"),
        ({"env": 3.0}, "env is 3.0, allowed: a name, an EnvSpec, or"),
        ({"env": Falling, "task": FallingTask, "sim_params": SIM_PARAMS}, "has episode_length 0"),
        ({"env": "Walker3d-v5", "task": FallingTask, "sim_params": SIM_PARAMS}, "Walker2d"),
        (
            {"env": "no_module:Env-v0", "task": FallingTask, "sim_params": SIM_PARAMS},
            r"wants the module no_module, which is missing; .*headway\[dm-control\]",
        ),
        ({"env": "hopper", "task": FallingTask, "sim_params": SIM_PARAMS}, "'hopper' is taken"),
    ],
)
def test_what_is_missing_is_one_line(given, says):
    with pytest.raises(HeadwayError, match=says) as caught:
        headway.train(**given)
    assert "\n" not in str(caught.value)


def test_an_episode_is_cut_where_gymnasium_cuts_it_by_default():
    headway.register(
        headway.EnvSpec(**{**vars(SPEC), "env_id": "Reacher-v5", "name": "", "episode_length": 0})
    )
    assert headway.make_config("Reacher-v5").collection.episode_length == 50


def config(**settings):
    named = {name: value for name, value in runs.TINY.items() if not name.startswith("model")}
    named |= {"collection.episode_length": 20, "collection.check": False, **settings}
    return headway.make_config(f"{__name__}:SPEC", preset="smoke", settings=named)


def test_short_episodes_make_more_of_them_wherever_the_run_is_stopped(tmp_path, monkeypatch):
    """Two episodes of 6 steps a round, so 30 steps are three rounds; physics alternate."""
    wanted = config(**{"collection.min_steps": 30, "collection.num_iterations": 2})
    run = train_run(wanted, tmp_path / "run")
    assert [row["collection"]["episodes"] for row in run.metrics()] == [6, 6]
    assert [row["timesteps"] for row in run.metrics()] == [36, 72]
    drawn = [one.sim_params["push"] for one in run.load_data()]
    assert all(sorted(drawn[i : i + 2]) == [0.5, 1.0] for i in range(0, 12, 2))
    assert len({one.obs[0, 0] for one in run.load_data()}) == 12

    save, saved = run_module.Partial.save, []

    def interrupted(self, name, *given):
        save(self, name, *given)
        saved.append(name)
        if name in ("collect-1", "fit") and saved.count(name) == 1:
            raise KeyboardInterrupt

    monkeypatch.setattr(run_module.Partial, "save", interrupted)
    for _ in range(2):
        with pytest.raises(KeyboardInterrupt):
            train_run(wanted, tmp_path / "stopped")
    train_run(wanted, tmp_path / "stopped")
    assert saved.count("collect") == saved.count("collect-1") == 2  # once an iteration
    assert runs.result(tmp_path / "stopped") == runs.result(tmp_path / "run")


def test_too_few_data_are_said_and_quick_asks_for_enough(tmp_path):
    few = config(**{"fitting.batch_size": 64, "collection.num_iterations": 1})
    with pytest.warns(UserWarning, match=r"12 transitions make 1 batches .* collection.min_steps"):
        train_run(few, tmp_path / "few")
    assert headway.make_config(f"{__name__}:SPEC", preset="quick").collection.min_steps > 0
    for env in BUILT_IN:
        assert headway.make_config(env, preset="quick").collection.min_steps == 0


@pytest.mark.parametrize("count", [4, 7])
def test_training_physics_are_dealt_evenly(count):
    sets = headway.SimParamSets(
        {"a": (1.0, 2.0, 3.0), "b": headway.Uniform(0.0, 1.0), "c": (1.0, 2.0)}
    )
    dealt = sets.deal(np.random.default_rng(0), count)
    for name, share in (("a", 3), ("c", 2)):
        times = np.unique([one[name] for one in dealt], return_counts=True)[1]
        assert len(times) == share
        assert np.ptp(times) <= 1
    slots = np.sort([one["b"] for one in dealt]) * count
    assert (slots.astype(int) == np.arange(count)).all()
    assert dealt != sets.deal(np.random.default_rng(1), count)
