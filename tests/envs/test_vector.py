"""Many environments stepped together are the same environments stepped one by one."""

import dataclasses

import gymnasium
import numpy as np
import pytest
from env_helpers import NAMES, ROBOTS, assert_same, distinct_physics
from gymnasium.vector import AutoresetMode

import misbehaving
from headway import envs
from headway.envs import ClassicVectorEnv, RobotVectorEnv, SequentialVectorEnv
from headway.errors import BadEnvironmentError, ConfigError, UnknownNameError
from headway.sim_params import SimParamSets
from headway.task import EnvSpec, env_spec, register
from headway.worlds.classic import PendulumTask

NUM = 5


CASES = [(name, {}, 8) for name in NAMES]
CASES += [("cartpole-swingup", {"terminate_off_track": True}, 500)]


@pytest.mark.parametrize(("name", "options", "length"), CASES)
def test_equals_stepping_one_by_one(name, options, length):
    """Over some episodes each, all kinds of physics and actions, and seeds as in Gymnasium.

    Finished ones stand still until they are reset, which leaves the others as they are.
    """
    together = envs.make_vec(name, NUM, episode_length=length, options=options)
    one = lambda: envs.make(name, max_episode_steps=length, **options)  # noqa: E731
    apart = SequentialVectorEnv([one] * NUM, episode_length=length)
    assert isinstance(together, RobotVectorEnv if name in ROBOTS else ClassicVectorEnv)
    assert together.metadata["autoreset_mode"] is AutoresetMode.DISABLED
    physics = {"sim_params": distinct_physics(name, NUM)}
    assert_same(*(vector.reset(seed=11, options=physics) for vector in (together, apart)))
    rng, space = np.random.default_rng(0), together.action_space
    for _ in range(4):
        over = np.zeros(NUM, bool)
        for step in range(10 if length < 10 else 250):  # also beyond the end
            actions = rng.uniform(space.low, space.high) if step % 2 else space.high
            before = together.step(actions)
            assert_same(before, apart.step(actions))
            assert not before[1][over].any()
            over = before[2] | before[3]
        assert over.all()
        mask = rng.random(NUM) < 0.5
        options = {"reset_mask": mask, "sim_params": {}}
        kept = before[0].copy()
        after = together.reset(options=options)
        assert_same(after, apart.reset(options=options))
        np.testing.assert_array_equal(after[0][~mask], before[0][~mask])
        np.testing.assert_array_equal(before[0], kept)  # returned arrays are the caller's
        options = {"reset_mask": over & ~mask, "sim_params": {}}
        assert_same(*(vector.reset(options=options) for vector in (together, apart)))
    together.close()


def test_gymnasium_makes_many_that_are_reset_by_themselves():
    vector = gymnasium.make_vec("headway/Pendulum-v0", 2, max_episode_steps=3)
    vector.reset(seed=0, options={"sim_params": {"length": 2.0}})
    rows = [vector.step(vector.action_space.sample()) for _ in range(4)]
    assert [row[3].tolist() for row in rows] == [[False] * 2] * 2 + [[True] * 2, [False] * 2]
    assert [2.0 in row[4]["sim_params"]["length"] for row in rows] == [True] * 3 + [False]


@pytest.mark.parametrize(
    ("options", "says"),
    [
        ({"sim_params": {"lenght": np.ones(3)}}, "Did you mean 'length'"),
        ({"sim_params": {"length": np.ones(2)}}, "one per environment"),
        ({"sim_params": {"length": np.array([1.0, np.nan, 1.0])}}, "above 0"),
        ({"sim_params": {"length": np.array(["a", "b", "c"])}}, "above 0"),
        ({"sim_params": 3}, "by parameter name"),
        ({"reset_mask": np.ones(2, bool)}, "3 booleans"),
        ({"reset_mask": np.ones(3)}, "3 booleans"),
        ({"reset_masks": np.ones(3, bool)}, "Did you mean 'reset_mask'"),
        ({"schedule": {-1: {"length": 1.0}}}, "whole numbers"),
        ({"schedule": {"soon": {"length": 1.0}}}, "whole numbers"),
        ({"schedule": {1: {"lenght": 1.0}}}, "Did you mean 'length'"),
        ({"schedule": {1: {"length": -1.0}}}, "above 0"),
        ({"schedule": {1: 2.0}}, "by parameter name"),
        ({"schedule": [{}]}, "one per"),
        ({"schedule": 3}, "mapping"),
    ],
)
def test_bad_options_are_refused_in_one_line_and_change_nothing(options, says):
    vector = envs.make_vec("pendulum", 3)
    obs, info = vector.reset(seed=0)
    with pytest.raises(ConfigError, match=says) as caught:
        vector.reset(seed=1, options=options)
    assert "\n" not in str(caught.value)
    np.testing.assert_array_equal(vector.observe(), obs)
    np.testing.assert_array_equal(vector.sim_params["length"], info["sim_params"]["length"])


def test_bad_arguments_are_refused():
    for arguments in ({"num_envs": 0}, {"num_envs": 1, "episode_length": 0}):
        with pytest.raises(ConfigError):
            envs.make_vec("pendulum", **arguments)
    for wrong in ({"sizes": {1, 2}}, {"gain": np.nan}):
        with pytest.raises(ConfigError, match="allowed: what JSON holds"):
            dataclasses.replace(DRIFT, options=wrong)
    with pytest.raises(UnknownNameError, match="Did you mean 'scale_inertia'"):
        envs.make_vec("hopper", 1, options={"scale_inertias": True})
    foreign = SequentialVectorEnv([lambda: gymnasium.make("Pendulum-v1")] * 2)
    foreign.reset(options={"schedule": {0: {"length": 1.0}}})
    with pytest.raises(ConfigError, match="no method set_sim_params"):
        foreign.step(np.zeros((2, 1), np.float32))
    for vector in (foreign, envs.make_vec("pendulum", 2)):
        vector.reset(seed=0)
        for shape in ((3, 1), (1, 1), (2,), ()):
            with pytest.raises(ConfigError, match="action"):
                vector.step(np.zeros(shape))
    with pytest.raises(ConfigError, match="seed"):
        vector.reset(seed=[1, 2, 3])
    with pytest.raises(ConfigError, match="env_fns"):
        SequentialVectorEnv([])


def test_a_simulation_that_diverges_costs_its_own_episode_only(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)  # MuJoCo leaves a log there
    vector, plain = (envs.make_vec("half-cheetah", 17) for _ in range(2))  # more than processors
    for one in (vector, plain):
        one.reset(seed=0)
    state = vector.get_state(1)
    state[9:18] = 1e12
    vector.set_state(1, state)
    action = vector.action_space.sample()
    obs, reward, terminated, truncated, info = vector.step(action)
    assert info["broken"] == {1: "the simulation of half-cheetah diverged (BADQVEL)"}
    assert not terminated.any()
    for bad in (truncated, np.isnan(obs).all(1), np.isnan(reward)):
        assert np.flatnonzero(bad).tolist() == [1]
    np.testing.assert_array_equal(np.delete(obs, 1, 0), np.delete(plain.step(action)[0], 1, 0))
    obs, info = vector.reset(options={"reset_mask": truncated})
    assert "broken" not in info
    assert np.isfinite(obs).all()
    vector.close()
    plain.close()


gymnasium.register("own/VectorDrift-v0", "misbehaving:Drift")
SETS = SimParamSets({"drift": (1.0, 2.0)}, {"far": {"drift": (5.0,)}})
DRIFT = EnvSpec(
    name="drift",
    env_id="own/VectorDrift-v0",
    make_task=PendulumTask,
    sim_params=SETS,
    episode_length=6,
    default_sim_params={"drift": 1.0},
)
MOON = dataclasses.replace(
    env_spec("hopper"),
    name="moon-hopper",
    sim_params=SimParamSets({"mass_scale": (1 / 6,), "damping_scale": (1.0,)}),
    episode_length=50,
)


def test_environments_of_ones_own():
    vector = envs.make_vec("test_vector:DRIFT", 3)
    physics = np.array([1.0, 2.0, 5.0])
    start, info = vector.reset(seed=0, options={"sim_params": {"drift": physics}})
    np.testing.assert_array_equal(info["sim_params"]["drift"], physics)
    actions = np.arange(3, dtype=np.float32)[:, None]
    for step in range(6):
        obs, rewards, terminated, truncated, _ = vector.step(actions)
        np.testing.assert_array_equal(rewards, [0, 1, 2])
        assert (terminated.any(), truncated.all()) == (False, step == 5)
    assert np.abs(obs - start).min() > 0
    drawn = {float(vector.reset(seed=s)[1]["sim_params"]["drift"][0]) for s in range(20)}
    assert drawn == {1.0, 2.0}
    first = vector.reset(seed=4)[1]["sim_params"]["drift"]
    np.testing.assert_array_equal(vector.reset(seed=4)[1]["sim_params"]["drift"], first)
    assert isinstance(envs.make("test_vector:DRIFT").unwrapped, misbehaving.Drift)


gymnasium.register("own/VectorDrift-v3", "misbehaving:Drift")
IDS = ["own/VectorDrift", "test_vector:own/VectorDrift-v0", misbehaving.Drift]


@pytest.mark.parametrize("timeout_s", [None, 60.0])
@pytest.mark.parametrize("env_id", IDS)
def test_an_environment_is_named_as_gymnasium_names_it_or_by_what_makes_it(env_id, timeout_s):
    own, options = {"how": "give_up"}, {"at": 2, "drift": None}  # of any type that JSON has
    register(dataclasses.replace(DRIFT, name="named", env_id=env_id, options=own))
    vector = envs.make_vec("named", 1, options=options, step_timeout_s=timeout_s)
    vector.reset(seed=0)
    actions = np.ones((1, 1), np.float32)
    assert "broken" not in vector.step(actions)[-1]
    assert vector.step(actions)[-1]["broken"] == {0: "the robot fell apart"}
    vector.close()


@pytest.mark.parametrize(
    ("changes", "says"),
    [
        ({"reset": lambda self: self.reset()}, "argument 'seed'.* shimmy"),
        ({"reset": lambda self, **given: np.zeros(3)}, "returned no .* shimmy"),
        ({"step": lambda self, action: (action, 0.0, False, {})}, "got 4.* shimmy"),
    ],
)
def test_environments_that_cannot_serve_are_named_in_one_line(changes, says):
    kind = type("Unfit", (misbehaving.Drift,), dict(changes))
    register(dataclasses.replace(DRIFT, name="unfit", env_id=kind))
    with pytest.raises(BadEnvironmentError, match=says) as caught:  # noqa: PT012
        vector = envs.make_vec("unfit", 2)
        vector.reset()
        vector.step(np.zeros((2, 1), np.float32))
    assert "\n" not in str(caught.value)


def test_own_physics_under_another_name_steps_as_fast():
    """A spec of one's own for a built-in id keeps its vector environment."""
    vector = envs.make_vec("test_vector:MOON", 2, options={"scale_inertia": True})
    assert isinstance(vector, RobotVectorEnv)
    assert vector.episode_length == 50
    sim_params = vector.reset(options={"sim_params": {"damping_scale": 2.0}})[1]["sim_params"]
    assert sim_params["damping_scale"].tolist() == [2.0, 2.0]
    np.testing.assert_allclose(sim_params["mass_scale"], 1 / 6)
    vector.close()


CHANGES = {
    "pendulum": ({"length": 1.0, "mass": 1.0}, {"length": 0.5}),
    "half-cheetah": ({"mass_scale": 1.0, "damping_scale": 1.0}, {"mass_scale": 2.5}),
    "crippled-ant": ({"crippled_leg": 0}, {"crippled_leg": 2}),
}


@pytest.mark.parametrize("name", CHANGES)
def test_a_schedule_changes_the_physics_at_its_step_of_its_environment_only(name):
    before, change = CHANGES[name]
    env, one = envs.make_vec(name, 2), envs.make(name)
    actions = np.random.default_rng(0).uniform(-1, 1, (6, *env.action_space.shape))
    runs = []
    for schedule in (None, [{3: change}, {}], None):  # and the next episode knows nothing of it
        env.reset(seed=[7, 8], options={"sim_params": before, "schedule": schedule})
        runs.append(np.stack([env.step(action)[0] for action in actions]))
        for parameter, value in change.items():
            now = value if schedule else before[parameter]
            assert env.sim_params[parameter].tolist() == [now, before[parameter]]
    np.testing.assert_array_equal(runs[0], runs[2])
    same = (runs[0] == runs[1]).all(-1)
    assert same[:, 1].all()
    assert same[:3, 0].all()
    assert not same[3:, 0].any()
    one.reset(seed=7, options={"sim_params": before, "schedule": {3: change}})
    alone = np.stack([one.step(action)[0] for action in actions[:, 0]])
    np.testing.assert_array_equal(alone, runs[1][:, 0])


def test_changes_add_up_until_the_next_step_and_end_with_the_episode():
    vector, still = SequentialVectorEnv([lambda: envs.make("pendulum")]), np.zeros((1, 1))
    own, before = vector.envs[0].unwrapped.vector, {"length": 1.0, "mass": 1.0}
    vector.reset(seed=0, options={"sim_params": before})
    vector.set_sim_params(0, {"length": 0.5})
    vector.set_sim_params(0, {"mass": 2.0})
    vector.step(still)
    assert (own.sim_params["length"], own.sim_params["mass"]) == (0.5, 2.0)
    vector.set_sim_params(0, {"length": 0.75})
    vector.reset(options={"sim_params": before})
    vector.step(still)
    assert (own.sim_params["length"], own.sim_params["mass"]) == (1.0, 1.0)
