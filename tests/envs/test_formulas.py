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


def test_pendulum_step():
    env = envs.make("pendulum")
    state, obs, reward = stepped(env, [0.3, -1.0], [1.5], length=0.5, mass=1.0)
    # 1.5 g/l sin θ + 3 u/(m l²) = 30 sin 0.3 + 18 = 26.86560619984019
    spin = -1.0 + 0.05 * 26.86560619984019
    np.testing.assert_allclose(state, [0.3 + 0.05 * spin, spin], rtol=1e-14)
    np.testing.assert_allclose(obs, [np.cos(state[0]), np.sin(state[0]), spin], rtol=1e-6)
    assert reward == pytest.approx(-(0.09 + 0.1 + 0.001 * 2.25), rel=1e-12)


def test_pendulum_integrates_before_it_clips():
    env = envs.make("pendulum")
    state, _, _ = stepped(env, [0.0, 7.9], [2.0], length=0.25, mass=1.0)
    # 3 u/(m l²) dt = 6 / 0.0625 · 0.05 = 4.8
    np.testing.assert_allclose(state, [0.05 * 12.7, 8.0], rtol=1e-12)


def test_pendulum_mass_divides_the_torque_only():
    env = envs.make("pendulum")
    light = stepped(env, [0.0, 0.0], [1.0], length=1.0, mass=1.0)[0][1]
    heavy = stepped(env, [0.0, 0.0], [1.0], length=1.0, mass=2.0)[0][1]
    assert light == pytest.approx(0.15)
    assert heavy == pytest.approx(0.075)


def test_pendulum_reward_wraps_the_angle():
    env = envs.make("pendulum")
    reward = stepped(env, [2 * np.pi + 0.1, 0.0], [0.0], length=1.0, mass=1.0)[2]
    assert reward == pytest.approx(-0.01, rel=1e-9)


def test_pendulum_reset():
    env = envs.make("pendulum")
    states = np.array([env.reset(seed=s) and env.unwrapped.get_state() for s in range(300)])
    assert (np.abs(states) < [np.pi, 1.0]).all()
    assert (np.abs(states).max(0) > [3.0, 0.95]).all()


@pytest.mark.parametrize("scale", [1.0, 0.25, 3.0])
def test_cartpole_step(scale):
    env = envs.make("cartpole-swingup")
    x, v, angle, spin, action = 0.1, 0.5, 2.5, -1.5, 0.7
    state, obs, reward = stepped(env, [x, v, angle, spin], [action], mass_scale=scale)
    # Newton's equations of cart and uniform rod, solved instead of written out:
    # M ẍ - (m l/2) cos θ θ̈ + ... with the rod's inertia m l²/3 about its end.
    m = mc = 0.5 * scale
    length, g, b = 0.6, 9.82, 0.1
    force = 10 * np.float32(action) - b * v
    # `θ` of the source grows towards negative x when its sine enters as below.
    lhs = np.array(
        [
            [m + mc, -0.5 * m * length * np.cos(angle)],
            [-0.5 * m * length * np.cos(angle), m * length**2 / 3],
        ]
    )
    rhs = np.array(
        [
            force - 0.5 * m * length * spin**2 * np.sin(angle),
            0.5 * m * g * length * np.sin(angle),
        ]
    )
    x_dd, angle_dd = np.linalg.solve(lhs, rhs)
    expected = [x + 0.01 * v, v + 0.01 * x_dd, angle + 0.01 * spin, spin + 0.01 * angle_dd]
    np.testing.assert_allclose(state, expected, rtol=1e-7)
    direction = [np.cos(expected[2]), np.sin(expected[2])]
    np.testing.assert_allclose(obs, [*expected[:2], *direction, expected[3]], rtol=1e-6)
    assert reward == pytest.approx((1 + np.cos(expected[2])) / 2, abs=1e-7)


def test_cartpole_reset():
    env = envs.make("cartpole-swingup")
    states = np.array([env.reset(seed=s) and env.unwrapped.get_state() for s in range(400)])
    np.testing.assert_allclose(states.mean(0), [0, 0, np.pi, 0], atol=0.05)
    np.testing.assert_allclose(states.std(0), 0.2, atol=0.03)


def raw(env):
    data = env.unwrapped.vector.datas[0]
    return data.qpos.copy(), data.qvel.copy()


def test_hopper_observation_and_reward():
    env = envs.make("hopper")
    obs, _ = env.reset(seed=1)
    assert obs[11] == 0.0
    for action in actions_of("hopper", "extreme", 60):
        before, (obs, reward, *_) = raw(env), env.step(action)
        qpos, qvel = raw(env)
        velocity = (qpos[0] - before[0][0]) / 0.008
        np.testing.assert_array_equal(obs[:11], [*qpos[1:], *np.clip(qvel, -10, 10)])
        assert obs[11] == pytest.approx(velocity, rel=1e-12)
        assert reward == pytest.approx(velocity + 1 - 1e-3 * np.sum(action**2), rel=1e-6)
    assert np.abs(qvel).max() > 0


def test_hopper_as_released():
    new, old = envs.make("hopper"), envs.make("hopper", observe_average_velocity=False)
    assert old.reset(seed=1)[0].shape == (11,)
    np.testing.assert_array_equal(old.reset(seed=1)[0], new.reset(seed=1)[0][:11])
    action = np.full(3, 0.3, np.float32)
    a, b = new.step(action), old.step(action)
    np.testing.assert_array_equal(b[0], a[0][:11])
    assert b[1] == a[1]


def test_slim_humanoid_observation_and_reward():
    env = envs.make("slim-humanoid")
    env.reset(seed=1)
    heights = []
    for action in actions_of("slim-humanoid", "extreme", 150):
        before, (obs, reward, *_) = raw(env), env.step(action)
        qpos, qvel = raw(env)
        np.testing.assert_array_equal(obs, [*qpos[2:], *qvel])
        heights.append(qpos[2])
        paid = 0.25 / 0.015 * before[1][0] - 0.1 * np.sum(action.astype(float) ** 2)
        assert reward == pytest.approx(paid + 5.0 * (1.0 <= qpos[2] <= 2.0), rel=1e-9)
    assert min(heights) < 1.0 < max(heights)  # the bonus was paid, and was not


def test_half_cheetah_observation_and_reward():
    env = envs.make("half-cheetah")
    obs, _ = env.reset(seed=1)
    assert obs[0] == 0.0
    for action in actions_of("half-cheetah", "random", 40):
        before, (obs, reward, *_) = raw(env), env.step(action)
        qpos, qvel = raw(env)
        velocity = (qpos[0] - before[0][0]) / 0.05
        np.testing.assert_allclose(obs, [velocity, *qpos[1:], *qvel], rtol=1e-12)
        assert reward == pytest.approx(velocity - 0.1 * np.sum(action**2), rel=1e-6)


def test_crippled_ant_observation_and_reward():
    env = envs.make("crippled-ant")
    env.reset(seed=1)
    for action in actions_of("crippled-ant", "extreme", 30):
        before, (obs, reward, *_) = raw(env), env.step(action)
        qpos, qvel = raw(env)
        rotation = np.zeros(9)
        mujoco.mju_quat2Mat(rotation, qpos[3:7])
        np.testing.assert_allclose(obs, [*qpos, *qvel, *rotation, *qpos[:3]], atol=1e-14)
        velocity = (qpos[0] - before[0][0]) / 0.05
        assert reward == pytest.approx(velocity + 0.05, rel=1e-9)


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
    plain, small = envs.make("crippled-ant"), envs.make("crippled-ant", shrink_leg=True)
    nominal = load_model("ant.xml")
    for env in (plain, small):
        env.reset(seed=0, options={"sim_params": {"crippled_leg": 3}})
        env.reset(seed=0, options={"sim_params": {"crippled_leg": 1}})
    upper, lower = (nominal.geom(n).id for n in ("right_leg_geom", "right_ankle_geom"))
    changed = np.flatnonzero(
        (small.unwrapped.vector.models[0].geom_size != nominal.geom_size).any(1)
    )
    np.testing.assert_array_equal(plain.unwrapped.vector.models[0].geom_size, nominal.geom_size)
    np.testing.assert_array_equal(changed, sorted([upper, lower]))
    half = nominal.geom_size[[upper, lower]] / 2
    np.testing.assert_array_equal(small.unwrapped.vector.models[0].geom_size[[upper, lower]], half)
    np.testing.assert_array_equal(
        small.unwrapped.vector.models[0].geom_pos[lower], nominal.geom_pos[upper]
    )


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
    ("name", "noise"),
    [("hopper", 0.005), ("slim-humanoid", 0.01), ("half-cheetah", None), ("crippled-ant", 0.1)],
)
def test_robot_resets(name, noise):
    env = envs.make(name)
    starts = [(env.reset(seed=s), raw(env))[1] for s in range(200)]
    nominal = env.unwrapped.vector.world.nominal
    away = np.array([qpos - nominal.qpos0 for qpos, _ in starts])
    speed = np.array([qvel for _, qvel in starts])
    if name in ("slim-humanoid", "crippled-ant"):
        norms = [np.linalg.norm(qpos[3:7]) for qpos, _ in starts]
        np.testing.assert_allclose(norms, 1.0, rtol=1e-12)
        away = np.delete(away, range(3, 7), axis=1)
    if noise is None:
        np.testing.assert_allclose(away.std(), 0.001, rtol=0.1)
        np.testing.assert_allclose(speed.std(), 0.001, rtol=0.1)
        return
    assert 0.95 * noise < np.abs(away).max() <= noise
    if name == "crippled-ant":
        np.testing.assert_allclose(speed.std(), 0.1, rtol=0.1)
    else:
        assert 0.95 * noise < np.abs(speed).max() <= noise


def test_masses_of_the_models():
    """Exact capsules; the half cheetah weighs 14 kg in total."""
    assert load_model("hopper.xml").body_mass.sum() == pytest.approx(15.820, abs=1e-3)
    assert load_model("half_cheetah.xml").body_mass.sum() == pytest.approx(14.0)
    assert load_model("ant.xml").body_mass.sum() == pytest.approx(0.9109, abs=1e-4)
    assert load_model("humanoid.xml").body_mass.sum() == pytest.approx(42.116, abs=1e-3)
    control_steps = [envs.make(name).unwrapped.vector.world.time_step for name in ROBOTS]
    assert control_steps == pytest.approx([0.008, 0.015, 0.05, 0.05])


@pytest.mark.parametrize("xml", ["hopper.xml", "humanoid.xml", "half_cheetah.xml", "ant.xml"])
def test_models_are_gymnasiums_but_for_their_looks(xml, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)  # MuJoCo logs what it deprecates
    assets = Path(gymnasium.__file__).parent / "envs" / "mujoco" / "assets"
    plain, ours = mujoco.MjModel.from_xml_path(str(assets / xml)), load_model(xml)
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


def test_loading_the_models_warns_of_nothing(capfd, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    load_model.cache_clear()
    load_model("half_cheetah.xml")
    assert capfd.readouterr() == ("", "")
    assert not list(tmp_path.iterdir())
