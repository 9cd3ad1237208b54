"""Physics that change during an episode, in single and in vector environments alike."""

import gymnasium
import numpy as np
import pytest
from gymnasium.vector import AutoresetMode

import misbehaving
from headway import envs
from headway.envs import SequentialVectorEnv
from headway.errors import ConfigError

CHANGES = {
    "pendulum": ({"length": 1.0, "mass": 1.0}, {"length": 0.5}),
    "half-cheetah": ({"mass_scale": 1.0, "damping_scale": 1.0}, {"mass_scale": 2.5}),
    "crippled-ant": ({"crippled_leg": 0}, {"crippled_leg": 2}),
}
CHANGE_AT, STEPS = 3, 6


def vector(name, num_envs=2, **kwargs):
    return envs.make_vec(name, num_envs, autoreset_mode=AutoresetMode.DISABLED, **kwargs)


def roll_out(env, actions):
    return np.stack([env.step(action)[0] for action in actions])


@pytest.mark.parametrize("name", CHANGES)
def test_a_schedule_changes_the_physics_at_its_step_of_its_environment_only(name):
    before, change = CHANGES[name]
    env = vector(name)
    actions = np.random.default_rng(0).uniform(-1, 1, (STEPS, *env.action_space.shape))
    runs = {}
    for label, schedule in (("none", None), ("first", [{CHANGE_AT: change}, {}])):
        env.reset(seed=[7, 8], options={"sim_params": before, "schedule": schedule})
        runs[label] = roll_out(env, actions)
    changed = env.sim_params
    for parameter, value in change.items():
        assert changed[parameter].tolist() == [value, before[parameter]]
    same = (runs["none"] == runs["first"]).all(-1)
    assert same[:, 1].all()
    assert same[:CHANGE_AT, 0].all()
    assert not same[CHANGE_AT:, 0].any()


@pytest.mark.parametrize("name", CHANGES)
def test_a_single_environment_follows_the_same_schedule(name):
    before, change = CHANGES[name]
    options = {"sim_params": before, "schedule": {CHANGE_AT: change}}
    many, one = vector(name, 1), envs.make(name)
    actions = np.random.default_rng(1).uniform(-1, 1, (STEPS, *one.action_space.shape))
    many.reset(seed=5, options=options)
    one.reset(seed=5, options=options)
    expected = roll_out(many, actions[:, None])[:, 0]
    np.testing.assert_array_equal(roll_out(one, actions), expected)


def test_the_next_episode_knows_nothing_of_the_schedule():
    env = envs.make_vec("pendulum", 1, episode_length=2)
    env.reset(seed=0, options={"schedule": {1: {"length": 9.0}}})
    action = np.zeros(env.action_space.shape)
    for _ in range(2):
        env.step(action)
    assert env.sim_params["length"][0] == 9.0
    for _ in range(3):  # the reset, and both steps of the next episode
        env.step(action)
    assert env.sim_params["length"][0] != 9.0


@pytest.mark.parametrize(
    ("schedule", "text"),
    [
        ({-1: {"length": 1.0}}, "whole numbers"),
        ({"soon": {"length": 1.0}}, "whole numbers"),
        ({1: {"lenght": 1.0}}, "length"),
        ({1: {"length": -1.0}}, "above 0"),
        ({1: 2.0}, "by parameter name"),
        ([{}], "one per"),
        (3, "mapping"),
    ],
)
def test_a_bad_schedule_is_refused_in_one_line(schedule, text):
    with pytest.raises(ConfigError, match=text) as error:
        vector("pendulum").reset(options={"schedule": schedule})
    assert "\n" not in str(error.value)


def test_environments_that_cannot_change_say_so():
    env = SequentialVectorEnv(
        [lambda: gymnasium.make("Pendulum-v1")], autoreset_mode=AutoresetMode.DISABLED
    )
    env.reset(options={"schedule": {0: {"length": 1.0}}})
    with pytest.raises(ConfigError, match="set_sim_params"):
        env.step(np.zeros((1, 1), np.float32))


def test_what_an_environment_does_not_tell_may_change_too():
    class Silent(misbehaving.Drift):
        def reset(self, **given):
            return super().reset(**given)[0], {}

        def set_sim_params(self, values):
            self.wind = values["wind"]

    one, other = Silent(), Silent()
    env = SequentialVectorEnv([lambda: one, lambda: other], autoreset_mode="Disabled")
    env.reset(options={"schedule": [{1: {"wind": 2.0}}, {}]})
    steps = [env.step(np.zeros((2, 1), np.float32))[-1]["sim_params"] for _ in range(2)]
    assert steps[0] == {}
    np.testing.assert_array_equal(steps[1]["wind"], [2.0, np.nan])
    assert one.wind == 2.0
