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


@pytest.mark.parametrize("name", CHANGES)
def test_a_schedule_changes_the_physics_at_its_step_of_its_environment_only(name):
    before, change = CHANGES[name]
    env, one = envs.make_vec(name, 2, autoreset_mode=AutoresetMode.DISABLED), envs.make(name)
    actions = np.random.default_rng(0).uniform(-1, 1, (STEPS, *env.action_space.shape))
    runs = []
    for schedule in (None, [{CHANGE_AT: change}, {}]):
        env.reset(seed=[7, 8], options={"sim_params": before, "schedule": schedule})
        runs.append(np.stack([env.step(action)[0] for action in actions]))
    for parameter, value in change.items():
        assert env.sim_params[parameter].tolist() == [value, before[parameter]]
    same = (runs[0] == runs[1]).all(-1)
    assert same[:, 1].all()
    assert same[:CHANGE_AT, 0].all()
    assert not same[CHANGE_AT:, 0].any()
    one.reset(seed=7, options={"sim_params": before, "schedule": {CHANGE_AT: change}})
    alone = np.stack([one.step(action)[0] for action in actions[:, 0]])
    np.testing.assert_array_equal(alone, runs[1][:, 0])


def test_the_next_episode_knows_nothing_of_the_schedule():
    env = envs.make_vec("pendulum", 1, episode_length=2)
    env.reset(seed=0, options={"schedule": {1: {"length": 9.0}}})
    lengths = []
    for _ in range(5):  # two steps, the reset, and both steps of the next episode
        env.step(np.zeros((1, 1)))
        lengths.append(env.sim_params["length"][0])
    assert lengths[1] == 9.0
    assert 9.0 not in lengths[2:]


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
        envs.make_vec("pendulum", 2).reset(options={"schedule": schedule})
    assert "\n" not in str(error.value)


def test_environments_of_ones_own_change_if_they_can():
    plain = SequentialVectorEnv([lambda: gymnasium.make("Pendulum-v1")])
    plain.reset(options={"schedule": {0: {"length": 1.0}}})
    with pytest.raises(ConfigError, match="set_sim_params"):
        plain.step(np.zeros((1, 1), np.float32))
    env = SequentialVectorEnv([misbehaving.Drift, misbehaving.Drift])
    env.reset(options={"schedule": [{1: {"drift": 2.0}}, {}]})
    steps = [env.step(np.zeros((2, 1)))[-1]["sim_params"]["drift"].tolist() for _ in range(2)]
    assert steps == [[0.5, 0.5], [2.0, 0.5]]
    assert env.envs[0].drift == 2.0
