"""Numbers worked out by hand from the sources, one environment at a time."""

from pathlib import Path

import gymnasium
import mujoco
import numpy as np
import pytest
from env_helpers import ROBOTS, actions_of

from headway import envs
from headway.worlds.locomotion import load_model


def stepped(env, state, action, **sim_params):
    env.reset(seed=0, options={"sim_params": sim_params})
    env.unwrapped.set_state(np.array(state))
    obs, reward, *_ = env.step(np.array(action))
    return env.unwrapped.get_state(), obs, reward


@pytest.mark.parametrize(
    ("start", "torque", "length", "mass", "gain", "spin", "wrapped"),
    [
        # 1.5 g/l sin θ + 3 u/(m l²) = 30 sin 0.3 + 18 = 26.86560619984019
        ([0.3, -1.0], 1.5, 0.5, 1.0, 1.0, -1.0 + 0.05 * 26.86560619984019, 0.3),
        # 3 u/(m l²) dt = 6 / 0.0625 · 0.05 = 4.8; the angle moves before the speed is clipped
        ([0.0, 7.9], 2.0, 0.25, 1.0, 1.0, 12.7, 0.0),
        ([0.0, 0.0], 1.0, 1.0, 1.0, 1.0, 0.15, 0.0),
        ([0.0, 0.0], 2.0, 1.0, 1.0, -1.3, -0.39, 0.0),  # beyond the bounds; what was asked costs
        ([0.0, 0.0], 1.0, 1.0, 2.0, 1.0, 0.075, 0.0),  # mass divides the torque only
        (
            [2 * np.pi + 0.1, 0.0],
            0.0,
            1.0,
            1.0,
            1.0,
            0.75 * np.sin(0.1),
            0.1,
        ),  # reward wraps angles
    ],
)
def test_pendulum_step(start, torque, length, mass, gain, spin, wrapped):
    env = envs.make("pendulum")
    state, obs, reward = stepped(env, start, [torque], length=length, mass=mass, gain=gain)
    np.testing.assert_allclose(state, [start[0] + 0.05 * spin, min(spin, 8.0)], rtol=1e-12)
    np.testing.assert_allclose(obs, [np.cos(state[0]), np.sin(state[0]), state[1]], rtol=1e-6)
    cost = wrapped**2 + 0.1 * start[1] ** 2 + 0.001 * torque**2
    assert reward == pytest.approx(-cost, rel=1e-9)


@pytest.mark.parametrize(("scale", "gain"), [(1.0, 1.0), (0.25, 1.0), (3.0, -1.3)])
def test_cartpole_step(scale, gain):
    env = envs.make("cartpole-swingup")
    x, v, angle, spin, action = 0.1, 0.5, 2.5, -1.5, 0.7
    state, obs, reward = stepped(env, [x, v, angle, spin], [action], mass_scale=scale, gain=gain)
    # Newton's equations of cart and uniform rod, solved instead of written out:
    # M ẍ - (m l/2) cos θ θ̈ + ... with the rod's inertia m l²/3 about its end.
    # `θ` of the source grows towards negative x when its sine enters as below.
    m, length, g = 0.5 * scale, 0.6, 9.82
    arm, force = 0.5 * m * length, 10 * gain * np.float32(action) - 0.1 * v
    lhs = [[2 * m, -arm * np.cos(angle)], [-arm * np.cos(angle), m * length**2 / 3]]
    rhs = [force - arm * spin**2 * np.sin(angle), arm * g * np.sin(angle)]
    x_dd, angle_dd = np.linalg.solve(lhs, rhs)
    expected = [x + 0.01 * v, v + 0.01 * x_dd, angle + 0.01 * spin, spin + 0.01 * angle_dd]
    np.testing.assert_allclose(state, expected, rtol=1e-7)
    direction = [np.cos(expected[2]), np.sin(expected[2])]
    np.testing.assert_allclose(obs, [*expected[:2], *direction, expected[3]], rtol=1e-6)
    assert reward == pytest.approx((1 + np.cos(expected[2])) / 2, abs=1e-7)


def raw(env):
    data = env.unwrapped.vector.datas[0]
    return data.qpos.copy(), data.qvel.copy()


def rotation(quaternion):
    matrix = np.zeros(9)
    mujoco.mju_quat2Mat(matrix, quaternion)
    return matrix


# Seconds of a step, the observation, and the reward, of positions q and velocities v after it,
# velocities b before it, the average velocity u, and the sum e of squared actions.
LAWS = {
    "hopper": (
        0.008,
        lambda q, v, u: [*q[1:], *np.clip(v, -10, 10), u],
        lambda q, b, u, e: u + 1 - 1e-3 * e,
    ),
    "slim-humanoid": (
        0.015,
        lambda q, v, u: [*q[2:], *v],
        lambda q, b, u, e: 0.25 / 0.015 * b[0] - 0.1 * e + 5.0 * (1.0 <= q[2] <= 2.0),
    ),
    "half-cheetah": (0.05, lambda q, v, u: [u, *q[1:], *v], lambda q, b, u, e: u - 0.1 * e),
    "crippled-ant": (
        0.05,
        lambda q, v, u: [*q, *v, *rotation(q[3:7]), *q[:3]],
        lambda q, b, u, e: u + 0.05,
    ),
}


RELEASED = ("hopper", {"observe_average_velocity": False}, slice(11))


@pytest.mark.parametrize(
    ("name", "options", "seen"), [*((name, {}, slice(None)) for name in LAWS), RELEASED]
)
def test_observations_and_rewards_of_robots(name, options, seen):
    env, (seconds, observation, reward) = envs.make(name, **options), LAWS[name]
    obs, _ = env.reset(seed=1)
    np.testing.assert_allclose(obs, observation(*raw(env), 0.0)[seen], atol=1e-14)
    heights = []
    for action in actions_of(name, "extreme", 150):
        (start, before), (obs, paid, *_) = raw(env), env.step(action)
        qpos, qvel = raw(env)
        velocity, effort = (qpos[0] - start[0]) / seconds, np.sum(action.astype(float) ** 2)
        expected = observation(qpos, qvel, velocity)[seen]
        np.testing.assert_allclose(obs, expected, rtol=1e-12, atol=1e-14)
        assert paid == pytest.approx(reward(qpos, before, velocity, effort), rel=1e-9, abs=1e-9)
        heights.append(qpos[2])
    if name == "slim-humanoid":
        assert min(heights) < 1.0 < max(heights)  # the bonus was paid, and was not


@pytest.mark.parametrize(
    ("leg", "silent"), [(-1, []), (0, [2, 3]), (1, [4, 5]), (2, [6, 7]), (3, [0, 1])]
)
def test_crippled_leg_gets_no_control(leg, silent):
    env = envs.make("crippled-ant")
    env.reset(seed=0, options={"sim_params": {"crippled_leg": leg}})
    env.step(np.full(8, 0.5, np.float32))
    expected = np.full(8, 0.5)
    expected[silent] = 0.0
    np.testing.assert_array_equal(env.unwrapped.vector.datas[0].ctrl, expected)


def test_crippled_leg_shrinks_only_if_asked_for():
    nominal, models = load_model("ant.xml"), []
    for shrink_leg in (False, True):
        env = envs.make("crippled-ant", shrink_leg=shrink_leg)
        for leg in (3, 1):
            env.reset(seed=0, options={"sim_params": {"crippled_leg": leg}})
        models.append(env.unwrapped.vector.models[0])
    plain, small = models
    leg = upper, lower = [nominal.geom(n).id for n in ("right_leg_geom", "right_ankle_geom")]
    expected = nominal.geom_size.copy()
    np.testing.assert_array_equal(plain.geom_size, expected)
    expected[leg] /= 2
    np.testing.assert_array_equal(small.geom_size, expected)
    np.testing.assert_array_equal(small.geom_pos[lower], nominal.geom_pos[upper])


@pytest.mark.parametrize("name", [n for n in ROBOTS if n != "crippled-ant"])
@pytest.mark.parametrize("scale_inertia", [False, True])
def test_scales_change_what_they_say_and_nothing_else(name, scale_inertia):
    env = envs.make(name, scale_inertia=scale_inertia)
    nominal = env.unwrapped.vector.world.nominal
    env.reset(options={"sim_params": {"mass_scale": 0.5, "damping_scale": 3.0}})
    env.reset(options={"sim_params": {"mass_scale": 1.5, "damping_scale": 2.0}})
    model = env.unwrapped.vector.models[0]
    inertia = 1.5 if scale_inertia else 1.0
    np.testing.assert_array_equal(model.body_mass, nominal.body_mass * 1.5)
    np.testing.assert_array_equal(model.dof_damping, nominal.dof_damping * 2.0)
    np.testing.assert_array_equal(model.body_inertia, nominal.body_inertia * inertia)
    for field in ("dof_invweight0", "body_invweight0", "body_subtreemass", "dof_armature"):
        np.testing.assert_array_equal(getattr(model, field), getattr(nominal, field))


@pytest.mark.parametrize(
    ("name", "size", "first", "second"),
    [
        ("pendulum", 1, ("max", np.pi), ("max", 1.0)),
        ("cartpole-swingup", 2, ("std", 0.2), ("std", 0.2)),
        ("hopper", 6, ("max", 0.005), ("max", 0.005)),
        ("slim-humanoid", 24, ("max", 0.01), ("max", 0.01)),
        ("half-cheetah", 9, ("std", 0.001), ("std", 0.001)),
        ("crippled-ant", 15, ("max", 0.1), ("std", 0.1)),
    ],
)
def test_resets(name, size, first, second):
    """Uniform noise has a largest value, normal noise a standard deviation, in parts of a state."""
    env, middle = envs.make(name), [0, 0, np.pi, 0] if "cart" in name else [0, 0]
    if name in ROBOTS:
        nominal = env.unwrapped.vector.world.nominal
        middle = [*nominal.qpos0, *np.zeros(nominal.nv)]
    states = [env.reset(seed=s) and env.unwrapped.get_state()[: len(middle)] for s in range(300)]
    noise = np.array(states) - middle
    if name in ("slim-humanoid", "crippled-ant"):
        norms = np.linalg.norm(np.array(states)[:, 3:7], axis=1)
        np.testing.assert_allclose(norms, 1.0, rtol=1e-12)
        noise[:, 3:7] = 0.0
    parts = np.split(noise, [size], axis=1)
    for part, (kind, expected) in zip(parts, (first, second), strict=True):
        found = np.abs(part).max() if kind == "max" else part.std()
        assert 0.9 * expected < found < (1.0 + 1e-9 if kind == "max" else 1.1) * expected


@pytest.mark.parametrize("xml", ["hopper.xml", "humanoid.xml", "half_cheetah.xml", "ant.xml"])
def test_models_are_gymnasiums_but_for_their_looks(xml, tmp_path, monkeypatch, capfd):
    monkeypatch.chdir(tmp_path)
    load_model.cache_clear()
    ours = load_model(xml)
    assert capfd.readouterr() == ("", "")
    assert not list(tmp_path.iterdir())  # MuJoCo logs what it deprecates
    assets = Path(gymnasium.__file__).parent / "envs" / "mujoco" / "assets"
    plain = mujoco.MjModel.from_xml_path(str(assets / xml))
    plain.geom_size[plain.geom_type == mujoco.mjtGeom.mjGEOM_PLANE, :2] = 0.0  # without end
    looks = ("geom_rgba", "geom_matid", "mat_", "tex_", "light_")
    compared = 0
    for field in dir(plain):
        value = getattr(plain, field)
        if isinstance(value, np.ndarray) and not field.startswith(looks):
            np.testing.assert_array_equal(getattr(ours, field), value, err_msg=field)
            compared += 1
    assert compared > 100
    for field in ("timestep", "integrator", "solver", "iterations", "tolerance"):
        assert getattr(ours.opt, field) == getattr(plain.opt, field)
