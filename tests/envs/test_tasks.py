"""The Task says in JAX what the environment does in NumPy."""

import sys
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from env_helpers import NAMES, actions_of, all_physics, record

from headway import envs
from headway.errors import ConfigError, UnknownNameError
from headway.sim_params import SimParamSets
from headway.task import EnvSpec, env_names, env_spec, register
from headway.worlds.classic import PendulumTask
from headway.worlds.locomotion import HalfCheetahTask, HopperTask, SlimHumanoidTask


def task_of(name, **options):
    spec = env_spec(name)
    return spec.make_task(**{**spec.options, **options})


TASKS = {name: task_of(name) for name in NAMES} | {
    "hopper as released": task_of("hopper", observe_average_velocity=False)
}


@pytest.mark.parametrize("style", ["random", "extreme", "sine", "rest"])
@pytest.mark.parametrize("name", NAMES)
def test_reward_is_what_the_environment_paid(name, style):
    """Also in single precision, and for actions beyond their bounds."""
    env, reward = envs.make(name), jax.jit(TASKS[name].reward)
    for seed, sim_params in enumerate(all_physics(name)[:: 2 if style == "random" else 3]):
        actions = actions_of(name, style, 60, seed) * (1 if seed else 3)
        reset = {"seed": seed, "options": {"sim_params": sim_params}}
        obs, action, paid = record(env, actions, **reset)
        for bits, tolerance in ((64, 1e-9), (32, 2e-5)):
            with jax.enable_x64(bits == 64):
                given = (jnp.asarray(x, f"float{bits}") for x in (obs[:-1], action, obs[1:]))
                np.testing.assert_allclose(reward(*given), paid, rtol=1e-5, atol=tolerance)


def test_termination_is_what_the_environment_said():
    options = {"terminate_off_track": True}
    env, task = envs.make("cartpole-swingup", **options), task_of("cartpole-swingup", **options)
    obs, actions = [env.reset(seed=0)[0]], np.ones((150, 1), np.float32)
    steps = [env.step(action) for action in actions]
    obs, ends = jnp.array([*obs, *(step[0] for step in steps)]), [step[2] for step in steps]
    assert task.terminated(obs[:-1], jnp.asarray(actions), obs[1:]).tolist() == ends
    assert {*ends} == {False, True}
    still = TASKS["cartpole-swingup"]
    assert not still.terminated(jnp.zeros(5), jnp.zeros(1), jnp.full(5, 9.0))


@pytest.mark.parametrize("name", TASKS)
def test_postprocess_undoes_target(name):
    task, rng = TASKS[name], np.random.default_rng(0)
    obs, next_obs = jnp.asarray(rng.uniform(-100, 100, (2, 50, task.obs_size)), jnp.float32)
    again = task.postprocess(obs, task.target(obs, next_obs))
    np.testing.assert_allclose(again, next_obs, rtol=1e-5, atol=1e-4)


@pytest.mark.parametrize("name", TASKS)
def test_sizes_and_action_units(name):
    task = TASKS[name]
    assert task.feature_size == task.preprocess(jnp.zeros(task.obs_size)).shape[-1]
    assert task.feature_size == (11 if name == "hopper" else task.obs_size)
    obs, action = jnp.zeros((4, 3, task.obs_size)), jnp.zeros((4, 3, task.action_size))
    for function in (task.reward, task.released_reward, task.terminated):
        assert jax.eval_shape(function, obs, action, obs).shape == (4, 3)  # any leading axes
    ends = jnp.array([[-1.0], [0.0], [1.0]]) * jnp.ones(task.action_size)
    own = task.scale_action(ends)
    np.testing.assert_allclose(own[0], task.action_low)
    np.testing.assert_allclose(own[2], task.action_high)
    np.testing.assert_allclose(task.unscale_action(own), ends, atol=1e-6)


def test_half_cheetah_features_and_targets():
    task = HalfCheetahTask()
    obs, next_obs = np.arange(18.0) / 10, np.arange(18.0)[::-1] / 7
    features = task.preprocess(jnp.asarray(obs, jnp.float32))
    np.testing.assert_allclose(
        features, [obs[1], np.sin(obs[2]), np.cos(obs[2]), *obs[3:]], rtol=1e-6
    )
    delta = task.target(jnp.asarray(obs, jnp.float32), jnp.asarray(next_obs, jnp.float32))
    np.testing.assert_allclose(delta, [next_obs[0], *(next_obs - obs)[1:]], rtol=1e-5, atol=1e-6)


def test_average_velocity_of_the_hopper_is_no_feature_and_predicted_itself():
    obs, next_obs = jnp.arange(12.0), 2 * jnp.arange(12.0) + 1
    task = HopperTask()
    np.testing.assert_array_equal(task.preprocess(obs), obs[:11])
    np.testing.assert_array_equal(
        task.target(obs, next_obs), [*(next_obs - obs)[:11], next_obs[11]]
    )
    released = HopperTask(observe_average_velocity=False)
    action = jnp.zeros(3)
    assert released.reward(obs[:11], action, next_obs[:11]) == next_obs[5] + 1


def test_released_rewards():
    """What the released planners maximise: lags, and unscaled actions."""
    obs, next_obs = jnp.linspace(0.1, 1.9, 45), jnp.zeros(45)
    half = jnp.full(17, 0.2)  # half of the limit 0.4
    humanoid = 0.25 / 0.015 * obs[22] - 0.1 * 17 * 0.25
    got = SlimHumanoidTask().released_reward
    np.testing.assert_allclose(got(obs, half, next_obs), humanoid, rtol=1e-5)
    tall = obs.at[1].set(1.5)
    np.testing.assert_allclose(got(tall, half, next_obs), humanoid + 5, rtol=1e-5)
    cheetah = HalfCheetahTask().released_reward(obs[:18], jnp.full(6, 0.5), next_obs[:18])
    np.testing.assert_allclose(cheetah, obs[0] - 0.1 * 6 * 0.25, rtol=1e-5)
    hopper = HopperTask().released_reward(obs[:12], jnp.full(3, 0.5), next_obs[:12])
    np.testing.assert_allclose(hopper, obs[5] + 1 - 1e-3 * 3 * 0.25, rtol=1e-5)
    hanging = jnp.array([-1.0, 0.0, 2.0])
    pendulum = PendulumTask().released_reward(hanging, jnp.array([2.0]), hanging)
    np.testing.assert_allclose(pendulum, -(np.pi**2 + 0.4 + 0.001), rtol=1e-6)
    for name in ("crippled-ant", "cartpole-swingup"):
        task = TASKS[name]
        rows = jnp.linspace(0, 1, task.obs_size), jnp.ones(task.action_size)
        same = task.reward(*rows, rows[0] ** 2), task.released_reward(*rows, rows[0] ** 2)
        assert same[0] == same[1]


def test_the_six():
    assert tuple(env_names())[:6] == NAMES
    groups = {name: env_spec(name).sim_params.group_names[1:] for name in NAMES}
    assert groups.pop("crippled-ant") == ("leg-3",)
    assert all(names == ("low", "high") for names in groups.values())
    assert [env_spec(name).epochs for name in NAMES] == [5, 50, 50, 50, 50, 50]
    lengths = [env_spec(name).episode_length for name in NAMES]
    assert lengths == [200, 500, 500, 1000, 1000, 1000]


def spec(name="own", length=10, **defaults):
    sets = SimParamSets({"mass": (1.0,)})
    return EnvSpec(
        name=name,
        env_id="own/Env-v0",
        make_task=PendulumTask,
        sim_params=sets,
        episode_length=length,
        default_sim_params=defaults or {"mass": 1.0},
    )


OWN = spec()
NO_SPEC = 3


def test_specs_that_contradict_themselves_are_refused():
    for contradicting in ({"length": -1}, {"masses": 1.0}):
        with pytest.raises(ConfigError):
            spec(**contradicting)
    with pytest.raises(ConfigError, match="taken"):
        register(spec("hopper"))


def test_environments_of_a_module_here_are_named_as_asked_for(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", [path for path in sys.path if path])  # a console script's
    Path("my_carts.py").write_text("from test_tasks import OWN as cart\n")
    found = env_spec("my_carts:cart")
    assert (found.name, found.env_id) == ("my_carts:cart", OWN.env_id)


@pytest.mark.parametrize(
    ("name", "error", "says"),
    [
        ("hoper", UnknownNameError, "Did you mean 'hopper'"),
        ("headway/Hoper-v0", UnknownNameError, "Did you mean 'headway/Hopper-v0'"),
        ("no_module:cart", ConfigError, "'no_module' raised ModuleNotFoundError"),
        (":cart", ConfigError, "module:name"),
        ("test_tasks:OWM", UnknownNameError, "Did you mean 'OWN'"),
        ("test_tasks:NO_SPEC", ConfigError, "is of type int, allowed: an EnvSpec"),
        ("os:getpid", ConfigError, "allowed: an EnvSpec"),  # config.json may be a stranger's
    ],
)
def test_unknown_names_are_one_clear_line(name, error, says):
    with pytest.raises(error, match=says) as caught:
        env_spec(name)
    assert "\n" not in str(caught.value)
