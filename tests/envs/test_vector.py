"""Many environments stepped together are the same environments stepped one by one."""

import gymnasium
import numpy as np
import pytest
from env_helpers import NAMES, all_physics, distinct_physics
from gymnasium.vector import AutoresetMode

from headway import envs, task
from headway.envs import ClassicVectorEnv, RobotVectorEnv, SequentialVectorEnv
from headway.envs.classic import PendulumTask
from headway.errors import BadEnvironmentError, ConfigError, UnknownNameError
from headway.sim_params import SimParamSets
from headway.task import EnvSpec, env_spec, register

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
    """Over 210 steps, three episodes each, all kinds of physics and actions."""
    together, apart = envs.make_vec(name, NUM, episode_length=75), sequential(name, length=75)
    options = {"sim_params": distinct_physics(name, NUM)}
    assert_same(together.reset(seed=11, options=options), apart.reset(seed=11, options=options))
    space = together.action_space
    space.seed(0)
    ends = 0
    for step in range(210):
        actions = space.sample()
        if step % 3 == 0:
            actions = np.where(actions > 0, space.high, space.low)
        left, right = together.step(actions), apart.step(actions)
        assert_same(left, right)
        ends += left[3].sum()
    assert ends == 2 * NUM
    together.close()
    apart.close()


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
        after = together.reset(seed=None, options=options)
        assert_same(after, apart.reset(seed=None, options=options))
        np.testing.assert_array_equal(after[0][~mask], before[0][~mask])
        for key, values in after[1]["sim_params"].items():
            np.testing.assert_array_equal(values[~mask], before[4]["sim_params"][key][~mask])
    together.close()


def test_early_endings_restart_only_their_own_environment():
    options = {"terminate_off_track": True}
    together = envs.make_vec("cartpole-swingup", NUM, options=options)
    apart = sequential("cartpole-swingup", **options)
    assert_same(together.reset(seed=0), apart.reset(seed=0))
    terminated, at = np.zeros(NUM, int), set()
    for step in range(250):
        actions = np.ones((NUM, 1), np.float32)
        left = together.step(actions)
        assert_same(left, apart.step(actions))
        if terminated_now := tuple(np.flatnonzero(left[2])):
            at.add((step, terminated_now))
        terminated += left[2]
    assert (terminated > 1).all()
    assert len(at) > 2  # not all at the same time


@pytest.mark.parametrize("name", NAMES)
def test_seeds_as_in_gymnasium(name):
    vector = envs.make_vec(name, 3)
    together, info = vector.reset(seed=40)
    listed, _ = vector.reset(seed=[40, 41, 42])
    np.testing.assert_array_equal(together, listed)
    env = envs.make(name)
    for i in range(3):
        obs, single = env.reset(seed=40 + i)
        np.testing.assert_array_equal(together[i], obs)
        assert single["sim_params"] == {k: v[i] for k, v in info["sim_params"].items()}
    vector.close()


@pytest.mark.parametrize("name", NAMES)
def test_spaces_and_kinds(name):
    vector = envs.make_vec(name, 3, episode_length=4)
    env = envs.make(name)
    assert vector.single_observation_space == env.observation_space
    assert vector.single_action_space == env.action_space
    assert vector.num_envs == 3
    obs, _ = vector.reset(seed=0)
    assert obs in vector.observation_space
    robots = RobotVectorEnv if name in NAMES[2:] else ClassicVectorEnv
    assert isinstance(vector, robots)
    kept = obs.copy()
    vector.step(vector.action_space.sample())
    np.testing.assert_array_equal(obs, kept)  # returned arrays are the caller's
    vector.close()


def test_gymnasium_makes_the_same_vector_environment():
    vector = gymnasium.make_vec(
        "headway/Hopper-v0", 2, vectorization_mode="vector_entry_point", scale_inertia=True
    )
    assert isinstance(vector, RobotVectorEnv)
    assert vector.episode_length == 500
    assert vector.metadata["autoreset_mode"] is AutoresetMode.NEXT_STEP
    vector.close()


def test_own_physics_sets():
    sets = SimParamSets({"length": (2.0,), "mass": (3.0,)})
    vector = envs.make_vec("pendulum", 2, sim_params=sets)
    _, info = vector.reset(seed=0)
    np.testing.assert_array_equal(info["sim_params"]["length"], [2.0, 2.0])
    np.testing.assert_array_equal(info["sim_params"]["mass"], [3.0, 3.0])


def test_a_single_value_serves_all_environments():
    vector = envs.make_vec("pendulum", 3)
    _, info = vector.reset(seed=0, options={"sim_params": {"length": 1.5}})
    np.testing.assert_array_equal(info["sim_params"]["length"], [1.5] * 3)


@pytest.mark.parametrize(
    "options",
    [
        {"sim_params": {"lenght": np.ones(3)}},
        {"sim_params": {"length": np.ones(2)}},
        {"sim_params": {"length": np.array([1.0, np.nan, 1.0])}},
        {"sim_params": {"length": np.array(["a", "b", "c"])}},
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


def test_a_simulation_that_diverges_is_told(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)  # MuJoCo leaves a log there
    vector = envs.make_vec("half-cheetah", 3)
    vector.reset(seed=0)
    plain = envs.make_vec("half-cheetah", 3)
    plain.reset(seed=0)
    state = vector.get_state(1)
    state[9:18] = 1e12
    vector.set_state(1, state)
    action = vector.action_space.sample()
    obs, reward, terminated, truncated, info = vector.step(action)
    assert info["broken"] == {1: "the simulation of half-cheetah diverged (BADQVEL)"}
    assert (terminated.any(), truncated.tolist()) == (False, [False, True, False])
    assert np.isnan(obs).all(1).tolist() == np.isnan(reward).tolist() == [False, True, False]
    np.testing.assert_array_equal(obs[[0, 2]], plain.step(action)[0][[0, 2]])
    obs, _, _, _, info = vector.step(action)  # the next episode begins
    assert "broken" not in info
    assert np.isfinite(obs).all()
    assert np.isfinite(vector.step(action)[0]).all()
    vector.close()
    plain.close()


def test_more_environments_than_processors():
    vector = envs.make_vec("half-cheetah", 17)
    vector.reset(seed=0)
    assert np.isfinite(vector.step(vector.action_space.sample())[0]).all()
    vector.close()


class OwnEnv(gymnasium.Env):
    """A user's environment: a number that drifts by the hidden parameter."""

    observation_space = gymnasium.spaces.Box(-np.inf, np.inf, (3,), np.float64)
    action_space = gymnasium.spaces.Box(-2, 2, (1,), np.float32)

    def __init__(self, *, backwards=False):
        self.sign = -1 if backwards else 1

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.drift = self.sign * (options or {}).get("sim_params", {}).get("drift", 0.0)
        self.position = 0.0
        return np.full(3, self.position), {}

    def step(self, action):
        self.position += self.drift
        return np.full(3, self.position), float(action[0]), self.position > 3, False, {}


@pytest.fixture
def own_spec():
    gymnasium.register("own/Drift-v0", OwnEnv)
    sets = SimParamSets({"drift": (1.0, 2.0)}, {"far": {"drift": (5.0,)}})
    spec = EnvSpec(
        "drift",
        "own/Drift-v0",
        lambda backwards: PendulumTask(),
        sets,
        6,
        {"drift": 1.0},
        {"backwards": False},
    )
    register(spec)
    yield spec
    del gymnasium.registry["own/Drift-v0"], task._registered["drift"]


def test_environments_of_ones_own(own_spec):
    vector = envs.make_vec("drift", 3)
    _, info = vector.reset(seed=0, options={"sim_params": {"drift": np.array([1.0, 2.0, 5.0])}})
    np.testing.assert_array_equal(info["sim_params"]["drift"], [1, 2, 5])
    actions = np.arange(3, dtype=np.float32)[:, None]
    obs, rewards, terminated, truncated, info = vector.step(actions)
    np.testing.assert_array_equal(obs[:, 0], [1, 2, 5])
    np.testing.assert_array_equal(rewards, [0, 1, 2])
    np.testing.assert_array_equal(terminated, [False, False, True])
    assert not truncated.any()
    obs, rewards, _, _, info = vector.step(actions)
    np.testing.assert_array_equal(obs[:, 0], [2, 4, 0])  # the third started over
    assert rewards[2] == 0
    assert info["sim_params"]["drift"][2] in (1.0, 2.0)
    drawn = {float(vector.reset(seed=s)[1]["sim_params"]["drift"][0]) for s in range(20)}
    assert drawn == {1.0, 2.0}
    first = vector.reset(seed=4)[1]["sim_params"]["drift"]
    np.testing.assert_array_equal(vector.reset(seed=4)[1]["sim_params"]["drift"], first)


def test_options_and_time_limit_of_ones_own(own_spec):
    vector = envs.make_vec("drift", 2, options={"backwards": True}, episode_length=4)
    vector.reset(seed=0)
    cuts = [vector.step(np.zeros((2, 1), np.float32))[3].all() for _ in range(4)]
    assert cuts == [False, False, False, True]
    assert isinstance(envs.make("drift").unwrapped, OwnEnv)


def test_own_physics_under_another_name_steps_as_fast():
    """A spec of one's own for a built-in id keeps its vector environment."""
    spec = env_spec("hopper")
    register(
        EnvSpec(
            "moon-hopper",
            spec.env_id,
            spec.make_task,
            SimParamSets({"mass_scale": (1 / 6,), "damping_scale": (1.0,)}),
            50,
            dict(spec.default_sim_params),
            dict(spec.options),
        )
    )
    try:
        vector = envs.make_vec("moon-hopper", 2)
        assert isinstance(vector, RobotVectorEnv)
        assert vector.episode_length == 50
        assert vector.reset(seed=0)[1]["sim_params"]["mass_scale"][0] == pytest.approx(1 / 6)
        vector.close()
    finally:
        del task._registered["moon-hopper"]


@pytest.mark.parametrize("name", NAMES)
def test_physics_differ_between_neighbours(name):
    """From equal states under equal actions, every environment goes its own way."""
    physics = distinct_physics(name, len(all_physics(name)))
    number = len(all_physics(name))
    vector = envs.make_vec(name, number)
    start, _ = vector.reset(seed=[7] * number, options={"sim_params": physics})
    np.testing.assert_array_equal(start, np.broadcast_to(start[0], start.shape))
    vector.action_space.seed(0)
    for _ in range(10):
        action = np.broadcast_to(vector.single_action_space.high, vector.action_space.shape)
        obs = vector.step(action)[0]
    gaps = np.abs(obs[:, None] - obs[None]).max(-1)[np.triu_indices(number, 1)]
    assert gaps.min() > 1e-6
    vector.close()


class Brittle(gymnasium.Env):
    """Ends after `steps` steps and must not be stepped again."""

    observation_space = gymnasium.spaces.Box(-np.inf, np.inf, (1,), np.float32)
    action_space = gymnasium.spaces.Box(-1, 1, (1,), np.float32)

    def __init__(self, steps):
        self.steps = steps

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.count = 0
        return np.zeros(1, np.float32), {"sim_params": {}}

    def step(self, action):
        assert self.count < self.steps, "stepped after the end"
        self.count += 1
        return np.full(1, self.count, np.float32), 1.0, self.count == self.steps, False, {}


def test_finished_environments_stand_still_without_autoreset():
    env = SequentialVectorEnv(
        [lambda: Brittle(2), lambda: Brittle(4)], autoreset_mode=AutoresetMode.DISABLED
    )
    env.reset(seed=0)
    rows = [env.step(np.zeros((2, 1), np.float32))[:4] for _ in range(4)]
    assert [obs[:, 0].tolist() for obs, *_ in rows] == [[1, 1], [2, 2], [2, 3], [2, 4]]
    assert [reward.tolist() for _, reward, *_ in rows] == [[1, 1], [1, 1], [0, 1], [0, 1]]
    assert [ends.tolist() for *_, ends, _ in rows] == [
        [False, False],
        [True, False],
        [True, False],
        [True, True],
    ]
    env.reset(options={"reset_mask": np.array([True, False])})
    assert env.step(np.zeros((2, 1), np.float32))[0][:, 0].tolist() == [1, 4]


@pytest.mark.parametrize(
    ("result", "says"),
    [
        ((np.zeros(2), 0.0, False, False, {}), r"obs of shape \(2,\), allowed: \(1,\)"),
        ((np.zeros(1), None, False, False, {}), "reward None, allowed: a number"),
    ],
)
def test_misshapen_results_are_named(result, says, monkeypatch):
    monkeypatch.setattr(Brittle, "step", lambda self, action: result)
    env = SequentialVectorEnv([lambda: Brittle(2)])
    env.reset(seed=0)
    with pytest.raises(BadEnvironmentError, match=says):
        env.step(np.zeros((1, 1), np.float32))
