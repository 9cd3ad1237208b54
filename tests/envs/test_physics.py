"""Physics by name for MuJoCo environments, and observations that are flattened."""

import gymnasium
import mujoco
import numpy as np
import pytest
from gymnasium import spaces

import headway
import headway.envs
from headway.envs.physics import MujocoPhysics, adapted
from headway.envs.vector import SequentialVectorEnv
from headway.errors import ConfigError

ARRAYS = [name for name in dir(mujoco.MjModel) if name.split("_")[0] in
          ("body", "dof", "geom", "jnt", "actuator", "pair", "tendon", "cam", "light")]  # fmt: skip


def walker(**keywords):
    return adapted(gymnasium.make, None, id="Walker2d-v5", **keywords)


def arrays(model):
    found = {name: getattr(model, name) for name in ARRAYS}
    found = {name: np.array(x) for name, x in found.items() if isinstance(x, np.ndarray)}
    return found | {"gravity": np.array(model.opt.gravity)}


def changed(env, values):
    """What `values` change in the model, as factors."""
    env.reset(seed=0)
    before = arrays(env.unwrapped.model)
    env.set_sim_params(values)
    after = arrays(env.unwrapped.model)
    return {
        name: after[name][before[name] != 0] / before[name][before[name] != 0]
        for name in before
        if not np.array_equal(before[name], after[name])
    }


def run(env, steps, seed=0, **sim_params):
    obs, _ = env.reset(seed=seed, options={"sim_params": sim_params} if sim_params else None)
    rng, found = np.random.default_rng(seed), [obs]
    for _ in range(steps):
        found.append(env.step(rng.uniform(-1, 1, env.action_space.shape))[0])
    return np.array(found)


def test_default_physics_leave_an_environment_as_it_was_to_the_bit_also_after_others():
    env, plain = walker(), gymnasium.make("Walker2d-v5")
    expected = run(plain, 40)
    everything = {"mass": 1.0, "friction": 1.0, "joint:leg_joint.locked": 0.0, "gravity": 1.0}
    assert np.array_equal(run(env, 40), expected)
    before = arrays(plain.unwrapped.model)
    others = {"mass": 2.0, "joint:leg_joint.locked": 1.0, "actuator:3.gain": 0.0, "gravity": 0.1}
    assert not np.allclose(run(env, 40, **others), expected)
    for told in (everything, {}):
        assert np.array_equal(run(env, 40, **told), expected)
        assert all(np.array_equal(before[k], v) for k, v in arrays(env.unwrapped.model).items())


@pytest.mark.parametrize(
    ("values", "fields"),
    [
        ({"friction": 0.5}, {"geom_friction": 0.5}),
        ({"gravity": 2.0}, {"gravity": 2.0}),
        ({"gear": 3.0}, {"actuator_gear": 3.0}),
        ({"gain": 0.25}, {"actuator_gainprm": 0.25}),
        ({"damping": 2.0}, {"dof_damping": 2.0}),
        ({"friction": 0.5, "geom:floor.friction": 2.0}, {"geom_friction": (1.0, 0.5)}),
        ({"joint:foot_joint.damping": 0.5}, {"dof_damping": (0.5, 1.0)}),
        ({"actuator:0.gear": 0.5}, {"actuator_gear": (0.5, 1.0)}),
    ],
)
def test_a_parameter_scales_its_fields_and_no_others(values, fields):
    found = changed(walker(), values)
    found.pop("dof_dampingpoly", None)
    derived = {"actuator_acc0"} if "gear" in str(values) else set()
    assert {*found} - derived == {*fields}
    for name, factors in fields.items():
        assert set(found[name].round(12).tolist()) == set(np.atleast_1d(factors).tolist())


def test_masses_are_those_of_a_model_that_was_compiled_with_them():
    """Also what MuJoCo derives of them, such as the inertia that a contact feels."""
    env = walker()
    path = env.unwrapped.fullpath
    spec = mujoco.MjSpec.from_file(path)
    for geom in spec.geoms:
        geom.density *= 3.0 * (2.0 if geom.name == "torso_geom" else 1.0)
    expected = arrays(spec.compile())
    env.reset(options={"sim_params": {"mass": 3.0, "body:torso.mass": 2.0}})
    for name, value in arrays(env.unwrapped.model).items():
        np.testing.assert_allclose(value, expected[name], rtol=1e-9, atol=1e-12, err_msg=name)


@pytest.mark.parametrize("env_id", ["Walker2d-v5", "HalfCheetah-v5", "InvertedDoublePendulum-v5"])
def test_a_joint_that_is_locked_in_an_episode_stays_where_it_is_and_the_others_go_on(env_id):
    env = adapted(gymnasium.make, None, id=env_id)
    model, data = env.unwrapped.model, env.unwrapped.data
    joint = model.joint(model.njnt - 1)
    run(env, 4)
    env.set_sim_params({f"joint:{joint.name}.locked": 1.0})
    for _ in range(2):  # in which it comes to rest
        env.step(env.action_space.sample())
    at, others = data.qpos[joint.qposadr[0]], data.qpos[: joint.qposadr[0]].copy()
    for _ in range(20):
        env.step(env.action_space.sample())
    assert abs(data.qpos[joint.qposadr[0]] - at) < 1e-3
    assert np.abs(data.qpos[: joint.qposadr[0]] - others).max() > 0.01
    env.set_sim_params({f"joint:{joint.name}.locked": 0.0})
    for _ in range(5):
        env.step(env.action_space.sample())
    assert abs(data.qpos[joint.qposadr[0]] - at) > 0.01


@pytest.mark.parametrize(
    ("values", "text"),
    [
        ({"body:torsoo.mass": 2.0}, "Did you mean 'body:torso.mass'?"),
        ({"fricton": 2.0}, "Did you mean 'friction'?"),
        ({"friction": -1.0}, "friction is -1.0, allowed: a finite factor of at least 0"),
        ({"body:torso.mass": 0.0}, "body:torso.mass is 0.0, allowed: a finite factor above 0"),
        ({"joint:leg_joint.locked": 0.5}, "locked is 0.5, allowed: 0 or 1"),
    ],
)
def test_what_the_model_lacks_is_one_line_before_training(values, text, tmp_path):
    sim_params = {"train": {name: [value] for name, value in values.items()}}
    with pytest.raises(headway.HeadwayError) as error:
        headway.train(
            "Walker2d-v5", task=WalkerTask(), sim_params=sim_params, run_dir=tmp_path / "run"
        )
    assert text in str(error.value)
    assert "\n" not in str(error.value)
    assert not (tmp_path / "run").exists()


@pytest.mark.parametrize(
    "values",
    [{"gravity": np.nan}, {"gravity": "much"}, {"mass": np.inf}, {"joint:leg_joint.locked": None}],
)
def test_physics_that_are_no_finite_number_are_refused_as_they_come(values):
    env = walker()
    vector = SequentialVectorEnv([walker])
    for one in (env, vector):
        with pytest.raises(ConfigError, match=rf"{next(iter(values))} is .*, allowed: ") as refused:
            one.reset(options={"sim_params": values})
        assert "\n" not in str(refused.value)


class Fragile(gymnasium.ActionWrapper):
    """A walker whose simulation breaks when it is pushed to the end."""

    def __init__(self):
        super().__init__(gymnasium.make("Walker2d-v5"))

    def action(self, action):
        if action.max() == 1.0:
            self.unwrapped.data.qvel[:] = 1e20
        return action


def test_a_simulation_that_diverges_ends_its_episode_and_a_try_that_does_pays_nan(
    tmp_path, monkeypatch
):
    monkeypatch.chdir(tmp_path)  # MuJoCo leaves a log there
    vector = SequentialVectorEnv([lambda: MujocoPhysics(Fragile())] * 2)
    vector.reset(seed=0)
    calm, wild = np.zeros((3, 6)), np.ones((3, 6))
    before = vector.envs[0].unwrapped.data.qpos.copy()
    tried = vector.try_out(0, [calm, wild, calm])
    assert np.isnan(tried).tolist() == [False, True, False]
    assert tried[0] == tried[2]
    np.testing.assert_array_equal(vector.envs[0].unwrapped.data.qpos, before)
    _, rewards, _, truncated, info = vector.step(np.stack([calm[0], wild[0]]))
    assert info["broken"] == {1: "the simulation diverged (BADQVEL)"}
    assert truncated.tolist() == np.isnan(rewards).tolist() == [False, True]
    assert "broken" not in vector.reset(options={"reset_mask": truncated})[1]
    assert np.isfinite(vector.step(np.zeros((2, 6)))[1]).all()


class WalkerTask(headway.Task):
    def reward(self, obs, action, next_obs):
        return next_obs[..., 8]


class Scene(gymnasium.Env):
    """Observes a table of numbers; has a model of its own, whose physics are its own business."""

    action_space = spaces.Box(-1, 1, (1,), np.float32)

    def __init__(self, space):
        self.observation_space, self.model = space, walker().unwrapped.model

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.observation_space.seed(seed)
        return self.observation_space.sample(), {"sim_params": {"mass": 7.0}}


BOX = spaces.Box(-1, 1, (2, 2), np.float32)


@pytest.mark.parametrize(
    ("space", "size"),
    [
        (spaces.Dict(b=BOX, a=spaces.Box(-1, 1, (3,), np.float32)), 7),
        (spaces.Tuple([BOX, spaces.Discrete(3)]), 7),
        (BOX, 4),
        (spaces.Discrete(5), 5),
    ],
)
def test_observations_become_one_row_and_the_physics_of_others_are_not_touched(space, size):
    env = adapted(Scene, None, space=space)
    obs, info = env.reset(seed=1, options={"sim_params": {"mass": 2.0}})
    assert obs.shape == (size,)
    assert info["sim_params"] == {"mass": 7.0}
    assert not isinstance(env, MujocoPhysics)
    assert isinstance(MujocoPhysics(env), gymnasium.Env)  # a user may ask for it


def test_dm_control_has_the_same_names_and_restores_its_physics():
    pytest.importorskip("shimmy")
    try:
        env = adapted(gymnasium.make, None, id="shimmy:dm_control/cartpole-swingup-v0")
    except (AttributeError, ImportError, gymnasium.error.Error):
        pytest.skip("dm_control is missing or does not know this version of MuJoCo")
    expected = run(env, 30)
    assert expected.shape == (31, 5)
    assert not np.allclose(run(env, 30, **{"body:pole_1.mass": 3.0}), expected)
    assert np.array_equal(run(env, 30), expected)
