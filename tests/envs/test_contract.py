"""Promises of every environment."""

import dataclasses

import numpy as np
import pytest
from env_helpers import NAMES, ROBOTS, actions_of, all_physics, record
from gymnasium.utils.env_checker import check_env

import headway
from headway import envs
from headway import task as tasks
from headway.errors import BrokenEpisodeError, ConfigError, UnknownNameError
from headway.sim_params import SimParamSets
from headway.task import env_spec

OBS_SIZES = dict(zip(NAMES, (3, 5, 12, 45, 18, 41), strict=True))


@pytest.fixture(params=NAMES)
def name(request):
    return request.param


@pytest.fixture
def env(name):
    env = envs.make(name)
    yield env
    env.close()


@pytest.mark.filterwarnings("ignore:.*Box observation space (min|max)imum value is")
@pytest.mark.filterwarnings("ignore:.*Not able to test alternative render modes")
@pytest.mark.filterwarnings("ignore:.*we recommend using a symmetric and normalized space")
@pytest.mark.filterwarnings("error")
def test_gymnasium_accepts_it(env):
    check_env(env.unwrapped, skip_render_check=True)


def test_spaces_and_names(name, env):
    spec = env_spec(name)
    task = spec.make_task(**spec.options)
    assert env.observation_space.shape == (OBS_SIZES[name],) == (task.obs_size,)
    assert env.observation_space.dtype == (np.float64 if name in ROBOTS else np.float32)
    np.testing.assert_array_equal(env.action_space.low, np.float32(task.action_low))
    np.testing.assert_array_equal(env.action_space.high, np.float32(task.action_high))
    assert env.reset(seed=0)[0] in env.observation_space
    assert env_spec(spec.env_id) is spec
    assert (env.spec.id, env.spec.max_episode_steps) == (spec.env_id, spec.episode_length)


def test_sim_params_are_drawn_from_the_training_values(env, name):
    spec = env_spec(name)
    allowed = [{**spec.default_sim_params, **row} for row in spec.sim_params.group("train")]
    drawn = [env.reset(seed=seed)[1]["sim_params"] for seed in range(60)]
    assert all(values in drawn for values in allowed)
    assert all(values in allowed for values in drawn)
    key = next(iter(allowed[0]))
    own = envs.make(name, sim_params=SimParamSets({key: (3.0,)}))
    assert own.reset(seed=0)[1]["sim_params"][key] == 3.0


def test_a_spec_with_other_physics_and_length_is_made_with_them(name, monkeypatch):
    key = next(iter(env_spec(name).default_sim_params))
    own = dataclasses.replace(
        env_spec(name), name="own", sim_params=SimParamSets({key: (3.0,)}), episode_length=2
    )
    monkeypatch.setattr(tasks, "_registered", dict(tasks._registered))
    headway.register(own)
    env = envs.make("own")
    assert env.reset(seed=0)[1]["sim_params"][key] == 3.0
    assert [env.step(env.action_space.sample())[3] for _ in range(2)] == [False, True]
    env.close()


def test_sim_params_can_be_set_in_full_or_in_part_and_leave_the_start_alone(env, name):
    free, drawn = env.reset(seed=3)
    for values in all_physics(name):
        obs, info = env.reset(seed=3, options={"sim_params": values})
        np.testing.assert_array_equal(obs, free)
        assert info["sim_params"] == values
        assert env.step(env.action_space.sample())[4]["sim_params"] == values
    key, value = next(iter(values.items()))
    _, info = env.reset(seed=3, options={"sim_params": {key: value}})
    assert info["sim_params"] == drawn["sim_params"] | {key: value}
    state = env.unwrapped.get_state()
    env.unwrapped.set_sim_params(values)
    np.testing.assert_array_equal(env.unwrapped.get_state(), state)
    assert env.unwrapped.sim_params == values


def test_every_sim_param_changes_the_future(env, name):
    """Every pair of values of every parameter leads elsewhere from the same state."""
    defaults = dict(env_spec(name).default_sim_params)
    world, actions = env.unwrapped, actions_of(name, "extreme", 12)
    for key, default in defaults.items():
        values = {row[key] for row in all_physics(name)} | {default}
        if len(values) == 1:
            values.add(default * 2)
        env.reset(seed=0, options={"sim_params": defaults})
        start, ends = world.get_state(), []
        for value in sorted(values):
            env.reset(seed=0, options={"sim_params": {**defaults, key: value}})
            world.set_state(start)
            ends.append(np.array([env.step(action)[0] for action in actions]))
        gaps = np.abs(np.array(ends)[:, None] - ends).max((2, 3))
        assert gaps[~np.eye(len(ends), dtype=bool)].min() > 1e-4


def test_state_round_trip(env, name):
    """A copied state has the same future, the next step included."""
    actions, world, futures = actions_of(name, "random", 30), env.unwrapped, []
    record(env, actions[:10], seed=0)
    state, sim_params, obs = world.get_state(), world.sim_params, world.observation()
    for _ in range(2):
        np.testing.assert_array_equal(world.observation(), obs)
        futures.append([np.append(*env.step(action)[:2]) for action in actions[10:]])
        env.reset(seed=99, options={"sim_params": sim_params})
        world.set_state(state)
    np.testing.assert_array_equal(*futures)


def test_bad_values_are_refused(env, name):
    key = next(iter(env_spec(name).default_sim_params))
    for bad in (-0.5, np.nan, np.inf, "heavy", None, 4.0 if name == "crippled-ant" else 0.0):
        with pytest.raises(ConfigError, match="allowed") as caught:
            env.reset(options={"sim_params": {key: bad}})
        assert "\n" not in str(caught.value)


@pytest.mark.parametrize("name", ["pendulum", "cartpole-swingup"])
def test_a_gain_of_any_sign_is_drawn_alone_and_turns_the_action(name):
    env = envs.make(name, sim_params=SimParamSets({"gain": (-1, 0)}))
    default = dict(env_spec(name).default_sim_params)
    drawn = [env.reset(seed=seed)[1]["sim_params"] for seed in range(20)]
    assert {row["gain"] for row in drawn} == {-1.0, 0.0}
    assert all(row | {"gain": 1.0} == default for row in drawn)
    actions = actions_of(name, "random", 30)
    for gain, same in ((-1.0, -actions), (0.0, 0 * actions), (0.5, actions / 2)):
        asked = {"seed": 1, "options": {"sim_params": {"gain": gain}}}
        wanted = record(env, same, seed=1, options={"sim_params": {"gain": 1.0}})[0]
        np.testing.assert_allclose(record(env, actions, **asked)[0], wanted, rtol=1e-5, atol=1e-5)
    with pytest.raises(ConfigError, match=r"gain is nan, allowed: finite numbers\.$"):
        env.reset(options={"sim_params": {"gain": np.nan}})


def test_unknown_names_are_refused_with_a_hint(env, name):
    key = next(iter(env_spec(name).default_sim_params))
    with pytest.raises(ConfigError, match=f"Did you mean '{key}'"):
        env.reset(options={"sim_params": {key + "s": 1.0}})
    with pytest.raises(UnknownNameError, match="option"):
        envs.make(name, no_such_option=True)
    with pytest.raises(ConfigError):
        envs.make(name, sim_params=SimParamSets({key + "s": (1.0,)}))
    with pytest.raises(ConfigError, match="render_mode"):
        envs.HeadwayEnv(name, render_mode="human")


def test_actions_are_clipped_and_bad_ones_and_bad_states_refused(env):
    ends = []
    for action in (np.full(env.action_space.shape, 7.0), env.action_space.high):
        env.reset(seed=0)
        ends.append(env.step(action)[:2])
    np.testing.assert_array_equal(ends[0][0], ends[1][0])
    assert ends[0][1] == ends[1][1]
    for bad in (action[:-1], np.append(action, 0.0), np.full_like(action, np.nan)):
        with pytest.raises(ConfigError, match="action"):
            env.step(bad)
    with pytest.raises(ConfigError, match="state"):
        env.unwrapped.set_state(env.unwrapped.get_state()[:-1])


def test_a_simulation_that_diverges_is_told_and_a_good_state_ends_the_trouble(
    tmp_path, monkeypatch
):
    monkeypatch.chdir(tmp_path)  # MuJoCo leaves a log there
    env = envs.make("hopper")
    env.reset(seed=0)
    good, action = env.unwrapped.get_state(), env.action_space.sample()
    obs = env.step(action)[0]
    env.unwrapped.set_state(np.where(np.arange(len(good)) < 6, good, 1e12))
    with pytest.raises(BrokenEpisodeError, match=r"diverged \(BADQVEL\) under sim_params"):
        env.step(action)
    env.unwrapped.set_state(good)
    np.testing.assert_array_equal(env.step(action)[0], obs)
