"""What every environment promises."""

import gymnasium
import numpy as np
import pytest
from env_helpers import NAMES, ROBOTS, actions_of, all_physics, record
from gymnasium.utils.env_checker import check_env

from headway import envs
from headway.errors import BrokenEpisodeError, ConfigError, UnknownNameError
from headway.sim_params import SimParamSets
from headway.task import env_spec

OBS_SIZES = (3, 5, 12, 45, 18, 41)


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


def test_spaces(name, env):
    size = OBS_SIZES[NAMES.index(name)]
    task = env_spec(name).make_task(**env_spec(name).options)
    assert env.observation_space.shape == (size,) == (task.obs_size,)
    assert env.observation_space.dtype == (np.float64 if name in ROBOTS else np.float32)
    assert env.action_space.shape == (task.action_size,)
    np.testing.assert_array_equal(env.action_space.low, np.float32(task.action_low))
    np.testing.assert_array_equal(env.action_space.high, np.float32(task.action_high))
    obs, _ = env.reset(seed=0)
    assert obs in env.observation_space


def test_by_name_and_by_id_is_the_same(name, env):
    spec = env_spec(name)
    assert env_spec(spec.env_id) is spec
    assert type(gymnasium.make(spec.env_id).unwrapped) is type(env.unwrapped)


def test_seed_repeats_everything(env, name):
    actions = actions_of(name, "random", 20)
    first, _, rewards = record(env, actions, seed=5)
    again, _, same = record(env, actions, seed=5)
    other, _, _ = record(env, actions, seed=6)
    np.testing.assert_array_equal(first, again)
    np.testing.assert_array_equal(rewards, same)
    assert not np.array_equal(first, other)


def test_sim_params_are_drawn_from_the_training_values(env, name):
    allowed = env_spec(name).sim_params.group("train")
    drawn = [env.reset(seed=seed)[1]["sim_params"] for seed in range(60)]
    assert all(values in drawn for values in allowed)
    assert all(values in allowed for values in drawn)


def test_sim_params_can_be_set_in_full_or_in_part(env, name):
    for values in all_physics(name):
        _, info = env.reset(options={"sim_params": values})
        assert info["sim_params"] == values
        assert env.step(env.action_space.sample())[4]["sim_params"] == values
    key, value = next(iter(all_physics(name)[-1].items()))
    _, info = env.reset(seed=0, options={"sim_params": {key: value}})
    assert info["sim_params"] == env.reset(seed=0)[1]["sim_params"] | {key: value}


def test_setting_sim_params_leaves_the_random_state_alone(env, name):
    free, _ = env.reset(seed=3)
    for values in all_physics(name):
        fixed, _ = env.reset(seed=3, options={"sim_params": values})
        np.testing.assert_array_equal(free, fixed)


def test_every_sim_param_changes_the_future(env, name):
    """Every pair of values of every parameter leads elsewhere from the same state."""
    spec = env_spec(name)
    world, actions = env.unwrapped, actions_of(name, "extreme", 12)
    for key, default in spec.default_sim_params.items():
        values = {row[key] for row in all_physics(name)} | {default}
        if len(values) == 1:
            values.add(default * 2)
        env.reset(seed=0, options={"sim_params": dict(spec.default_sim_params)})
        start, ends = world.get_state(), []
        for value in sorted(values):
            env.reset(seed=0, options={"sim_params": {**spec.default_sim_params, key: value}})
            world.set_state(start)
            ends.append(np.array([env.step(action)[0] for action in actions]))
        for i, end in enumerate(ends):
            for other in ends[:i]:
                assert np.abs(end - other).max() > 1e-4


def test_state_round_trip(env, name):
    """A copied state has the same future, the next step included."""
    actions = actions_of(name, "random", 30)
    world = env.unwrapped
    record(env, actions[:10], seed=0)
    state, sim_params, obs = world.get_state(), world.sim_params, world.observation()
    future = [env.step(action)[:2] for action in actions[10:]]
    env.reset(seed=99, options={"sim_params": sim_params})
    world.set_state(state)
    np.testing.assert_array_equal(world.observation(), obs)
    for action, (next_obs, reward) in zip(actions[10:], future, strict=True):
        step = env.step(action)
        np.testing.assert_array_equal(step[0], next_obs)
        assert step[1] == reward


def test_set_sim_params_keeps_the_state(env, name):
    env.reset(seed=0)
    state = env.unwrapped.get_state()
    env.unwrapped.set_sim_params(all_physics(name)[-1])
    np.testing.assert_array_equal(env.unwrapped.get_state(), state)
    assert env.unwrapped.sim_params == all_physics(name)[-1]


@pytest.mark.parametrize("value", [-0.5, np.nan, np.inf, "heavy", None])
def test_bad_values_are_refused(env, name, value):
    key = next(iter(env_spec(name).default_sim_params))
    edge = 4.0 if name == "crippled-ant" else 0.0
    for bad in (value, edge):
        with pytest.raises(ConfigError, match="allowed") as caught:
            env.reset(options={"sim_params": {key: bad}})
        assert "\n" not in str(caught.value)


def test_unknown_names_are_refused_with_a_hint(env, name):
    key = next(iter(env_spec(name).default_sim_params))
    with pytest.raises(ConfigError, match=f"Did you mean '{key}'"):
        env.reset(options={"sim_params": {key + "s": 1.0}})
    with pytest.raises(ConfigError, match="Did you mean 'sim_params'"):
        env.reset(options={"sim_param": {key: 1.0}})
    with pytest.raises(UnknownNameError, match="option"):
        envs.make(name, no_such_option=True)
    with pytest.raises(ConfigError):
        envs.make(name, sim_params=SimParamSets({key + "s": (1.0,)}))
    with pytest.raises(ConfigError, match="render_mode"):
        envs.HeadwayEnv(name, render_mode="human")


def test_own_sets_replace_the_training_values(name):
    key = next(iter(env_spec(name).default_sim_params))
    env = envs.make(name, sim_params=SimParamSets({key: (3.0,)}))
    assert env.reset(seed=0)[1]["sim_params"][key] == 3.0


def test_bad_actions_and_states_are_refused(env):
    env.reset(seed=0)
    good = env.action_space.sample()
    for action in (good[:-1], np.append(good, 0.0), np.full_like(good, np.nan)):
        with pytest.raises(ConfigError, match="action"):
            env.step(action)
    with pytest.raises(ConfigError, match="state"):
        env.unwrapped.set_state(env.unwrapped.get_state()[:-1])


def test_actions_are_clipped(env, name):
    high = np.full(env.action_space.shape, 7.0)
    ends = []
    for action in (high, env.action_space.high):
        env.reset(seed=0)
        ends.append(env.step(action)[:2])
    np.testing.assert_array_equal(ends[0][0], ends[1][0])
    assert ends[0][1] == ends[1][1]


def test_time_limit(env, name):
    assert env.spec.max_episode_steps == env_spec(name).episode_length
    short = envs.make(name, max_episode_steps=3)
    short.reset(seed=0)
    ends = [short.step(short.action_space.sample())[2:4] for _ in range(3)]
    assert ends == [(False, False), (False, False), (False, True)]


def test_a_simulation_that_diverges_is_told(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)  # MuJoCo leaves a log there
    env = envs.make("half-cheetah")
    env.reset(seed=0)
    state = env.unwrapped.get_state()
    state[9:18] = 1e12
    env.unwrapped.set_state(state)
    with pytest.raises(BrokenEpisodeError, match=r"diverged \(BADQVEL\) under sim_params"):
        env.step(env.action_space.sample())


def test_a_good_state_ends_the_trouble_of_a_bad_one(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    env, other = envs.make("hopper"), envs.make("hopper")
    for one in (env, other):
        one.reset(seed=0)
    good, action = env.unwrapped.get_state(), env.action_space.sample()
    bad = good.copy()
    bad[6:12] = 1e12
    env.unwrapped.set_state(bad)
    with pytest.raises(BrokenEpisodeError):
        env.step(action)
    env.unwrapped.set_state(good)
    np.testing.assert_array_equal(env.step(action)[0], other.step(action)[0])


def test_leaving_the_track_ends_the_episode_if_asked_for():
    for ends in (False, True):
        env = envs.make("cartpole-swingup", terminate_off_track=ends)
        env.reset(seed=0)
        steps = [env.step(np.ones(1, np.float32)) for _ in range(200)]
        off = [abs(step[0][0]) > np.float32(2.4) for step in steps]
        assert any(off)
        assert [step[2] for step in steps] == [flag and ends for flag in off]


def test_unknown_environments_are_refused_with_a_hint():
    for call in (envs.make, lambda name: envs.make_vec(name, 2)):
        with pytest.raises(UnknownNameError, match="Did you mean 'hopper'"):
            call("hoper")
        with pytest.raises(UnknownNameError, match="Did you mean 'headway/Hopper-v0'"):
            call("headway/Hoper-v0")
