"""Many environments stepped together are the same environments stepped one by one."""

import gymnasium
import numpy as np
import pytest
from env_helpers import NAMES, all_physics, distinct_physics
from gymnasium.vector import AutoresetMode

import misbehaving
from headway import envs
from headway.envs import ClassicVectorEnv, RobotVectorEnv, SequentialVectorEnv
from headway.envs.classic import PendulumTask
from headway.errors import BadEnvironmentError, BrokenEpisodeError, ConfigError, UnknownNameError
from headway.sim_params import SimParamSets
from headway.task import EnvSpec, env_spec

NUM = 5


def sequential(name, mode=AutoresetMode.NEXT_STEP, length=None, **options):
    length = length or env_spec(name).episode_length
    one = lambda: envs.make(name, max_episode_steps=length, **options)  # noqa: E731
    return SequentialVectorEnv([one] * NUM, autoreset_mode=mode, episode_length=length)


def assert_same(left, right):
    """Bit for bit."""
    for a, b in zip(left[:-1], right[:-1], strict=True):
        np.testing.assert_array_equal(a, b)
    assert left[-1].keys() == right[-1].keys() == {"sim_params"}
    for name, values in left[-1]["sim_params"].items():
        np.testing.assert_array_equal(values, right[-1]["sim_params"][name])


@pytest.mark.parametrize("name", NAMES)
def test_equals_stepping_one_by_one(name):
    """Over three episodes each, all kinds of physics and actions, and seeds as in Gymnasium."""
    together, apart = envs.make_vec(name, NUM, episode_length=75), sequential(name, length=75)
    options = {"sim_params": distinct_physics(name, NUM)}
    assert_same(together.reset(seed=11, options=options), apart.reset(seed=11, options=options))
    space = together.action_space
    space.seed(0)
    for step in range(210):
        actions = space.sample()
        if step % 3 == 0:
            actions = np.where(actions > 0, space.high, space.low)
        left = together.step(actions)
        assert_same(left, apart.step(actions))
        assert left[3].all() == (step in (74, 150))
    kept = left[0].copy()
    together.step(actions)
    np.testing.assert_array_equal(left[0], kept)  # returned arrays are the caller's
    assert isinstance(together, RobotVectorEnv if name in NAMES[2:] else ClassicVectorEnv)
    together.close()


@pytest.mark.parametrize("name", NAMES)
def test_reset_mask_resets_only_the_chosen(name):
    disabled = AutoresetMode.DISABLED
    together = envs.make_vec(name, NUM, episode_length=8, autoreset_mode=disabled)
    apart = sequential(name, disabled, 8)
    physics = distinct_physics(name, NUM)
    assert_same(*(v.reset(seed=3, options={"sim_params": physics}) for v in (together, apart)))
    rng = np.random.default_rng(0)
    for _ in range(4):
        for _ in range(10):  # two steps beyond the end of the first episode
            actions = together.action_space.sample()
            before = together.step(actions)
            assert_same(before, apart.step(actions))
        mask = rng.random(NUM) < 0.5
        options = {"reset_mask": mask, "sim_params": {}}
        after = together.reset(options=options)
        assert_same(after, apart.reset(options=options))
        np.testing.assert_array_equal(after[0][~mask], before[0][~mask])
    together.close()


def test_early_endings_restart_only_their_own_environment():
    options = {"terminate_off_track": True}
    together = envs.make_vec("cartpole-swingup", NUM, options=options)
    apart = sequential("cartpole-swingup", **options)
    assert_same(together.reset(seed=0), apart.reset(seed=0))
    ends = []
    for _ in range(250):
        actions = np.ones((NUM, 1), np.float32)
        left = together.step(actions)
        assert_same(left, apart.step(actions))
        ends.append(left[2])
    assert (np.sum(ends, 0) > 1).all()
    assert any(0 < row.sum() < NUM for row in ends)


def test_finished_environments_stand_still_without_autoreset():
    env = SequentialVectorEnv(
        [lambda: misbehaving.Drift("end", at=2), misbehaving.Drift], autoreset_mode="Disabled"
    )
    env.reset(seed=0)
    rows = [env.step(np.ones((2, 1), np.float32))[:4] for _ in range(4)]
    assert [reward.tolist() for _, reward, *_ in rows] == [[1, 1], [1, 1], [0, 1], [0, 1]]
    assert [ends[0] for *_, ends, _ in rows] == [False, True, True, True]
    np.testing.assert_array_equal(rows[3][0][0], rows[1][0][0])


def test_gymnasium_makes_the_same_vector_environment():
    vector = gymnasium.make_vec(
        "headway/Hopper-v0", 2, vectorization_mode="vector_entry_point", scale_inertia=True
    )
    assert isinstance(vector, RobotVectorEnv)
    assert vector.episode_length == 500
    assert vector.metadata["autoreset_mode"] is AutoresetMode.NEXT_STEP
    vector.close()


def test_own_physics_sets_and_a_single_value_for_all():
    sets = SimParamSets({"length": (2.0,), "mass": (3.0,)})
    vector = envs.make_vec("pendulum", 2, sim_params=sets)
    _, info = vector.reset(seed=0, options={"sim_params": {"mass": 1.5}})
    assert info["sim_params"]["length"].tolist() == [2.0, 2.0]
    assert info["sim_params"]["mass"].tolist() == [1.5, 1.5]


@pytest.mark.parametrize(
    "options",
    [
        {"sim_params": {"lenght": np.ones(3)}},
        {"sim_params": {"length": np.ones(2)}},
        {"sim_params": {"length": np.array([1.0, np.nan, 1.0])}},
        {"sim_params": {"length": np.array(["a", "b", "c"])}},
        {"sim_params": 3},
        {"reset_mask": np.ones(2, bool)},
        {"reset_mask": np.ones(3)},
        {"reset_masks": np.ones(3, bool)},
    ],
)
def test_bad_options_are_refused_and_change_nothing(options):
    vector = envs.make_vec("pendulum", 3)
    obs, info = vector.reset(seed=0)
    with pytest.raises(ConfigError) as caught:
        vector.reset(seed=1, options=options)
    assert "\n" not in str(caught.value)
    np.testing.assert_array_equal(vector.observe(), obs)
    np.testing.assert_array_equal(vector.sim_params["length"], info["sim_params"]["length"])


def test_bad_arguments_are_refused():
    for arguments in ({"num_envs": 0}, {"num_envs": 1, "episode_length": 0}):
        with pytest.raises(ConfigError):
            envs.make_vec("pendulum", **arguments)
    with pytest.raises(ConfigError, match="SAME_STEP"):
        envs.make_vec("pendulum", 1, autoreset_mode=AutoresetMode.SAME_STEP)
    with pytest.raises(UnknownNameError, match="Did you mean 'scale_inertia'"):
        envs.make_vec("hopper", 1, options={"scale_inertias": True})
    separate = [lambda: gymnasium.make("Pendulum-v1")] * 2
    for vector in (SequentialVectorEnv(separate), envs.make_vec("pendulum", 2)):
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
    obs, _, _, _, info = vector.step(action)  # the next episode begins
    assert "broken" not in info
    assert np.isfinite(obs).all()
    vector.close()
    plain.close()


@pytest.mark.parametrize("name", NAMES)
def test_physics_differ_between_neighbours(name):
    """From equal states under equal actions, every environment goes its own way."""
    number = len(all_physics(name))
    vector = envs.make_vec(name, number)
    options = {"sim_params": distinct_physics(name, number)}
    start, _ = vector.reset(seed=[7] * number, options=options)
    np.testing.assert_array_equal(start, np.broadcast_to(start[0], start.shape))
    for _ in range(10):
        obs = vector.step(vector.action_space.high)[0]
    gaps = np.abs(obs[:, None] - obs[None]).max(-1)[np.triu_indices(number, 1)]
    assert gaps.min() > 1e-6
    vector.close()


gymnasium.register("own/VectorDrift-v0", "misbehaving:Drift")
SETS = SimParamSets({"drift": (1.0, 2.0)}, {"far": {"drift": (5.0,)}})
DRIFT = EnvSpec("drift", "own/VectorDrift-v0", PendulumTask, SETS, 6, {"drift": 1.0})
MOON = EnvSpec(
    "moon-hopper",
    "headway/Hopper-v0",
    env_spec("hopper").make_task,
    SimParamSets({"mass_scale": (1 / 6,), "damping_scale": (1.0,)}),
    50,
    {"mass_scale": 1.0, "damping_scale": 1.0},
    {"scale_inertia": False},
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
    info = vector.step(actions)[-1]  # the next episodes begin
    drawn = {*info["sim_params"]["drift"]}
    drawn |= {float(vector.reset(seed=s)[1]["sim_params"]["drift"][0]) for s in range(20)}
    assert drawn == {1.0, 2.0}
    first = vector.reset(seed=4)[1]["sim_params"]["drift"]
    np.testing.assert_array_equal(vector.reset(seed=4)[1]["sim_params"]["drift"], first)
    assert isinstance(envs.make("test_vector:DRIFT").unwrapped, misbehaving.Drift)


def test_own_physics_under_another_name_steps_as_fast():
    """A spec of one's own for a built-in id keeps its vector environment."""
    vector = envs.make_vec("test_vector:MOON", 2, options={"scale_inertia": True})
    assert isinstance(vector, RobotVectorEnv)
    assert vector.episode_length == 50
    assert vector.reset(seed=0)[1]["sim_params"]["mass_scale"][0] == pytest.approx(1 / 6)
    vector.close()


@pytest.mark.parametrize(
    ("how", "says"),
    [
        ("shrink", r"obs of shape \(2,\), allowed: \(3,\)"),
        ("lose_the_reward", "reward None, allowed: a number"),
    ],
)
def test_misshapen_results_are_named(how, says):
    env = SequentialVectorEnv([lambda: misbehaving.Drift(how, at=1)])
    env.reset(seed=0)
    with pytest.raises(BadEnvironmentError, match=says):
        env.step(np.zeros((1, 1), np.float32))


def test_a_next_episode_that_cannot_begin_is_cut_and_tried_again():
    class Falls(misbehaving.Drift):
        def reset(self, **given):
            if self.elapsed:
                self.elapsed = 0
                raise BrokenEpisodeError("it fell over")
            return super().reset(**given)

    vector = SequentialVectorEnv([Falls, misbehaving.Drift], episode_length=2)
    vector.reset(seed=0)
    ones = np.ones((2, 1), np.float32)
    for _ in range(2):
        vector.step(ones)
    obs, reward, _, truncated, info = vector.step(ones)
    assert info["broken"] == {0: "it fell over"}
    assert np.isnan(obs).any(1).tolist() == [True, False]
    assert np.isnan(reward).tolist() == truncated.tolist() == [True, False]
    obs, reward, _, truncated, info = vector.step(ones)  # begins at last
    assert "broken" not in info
    assert np.isfinite(obs).all()
    assert (reward.tolist(), truncated.tolist()) == ([0.0, 1.0], [False, False])


@pytest.mark.parametrize("how", ["change_spaces", "change_actions"])
def test_spaces_must_stay_as_they_are(how):
    vector = SequentialVectorEnv([lambda: misbehaving.Drift(how, at=0), misbehaving.Drift])
    with pytest.raises(BadEnvironmentError, match=r"space .*allowed: .* in every episode"):
        vector.reset(seed=0)
