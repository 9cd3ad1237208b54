import dataclasses

import numpy as np

import headway
from headway import task
from headway.lab.dynamics import choose_views, collect_changes, plot_dynamics
from headway.task import BUILT_IN, env_spec


def test_the_views_are_the_numbers_that_tell_physics_apart():
    rng = np.random.default_rng(0)
    varied = np.repeat(rng.normal(size=(1, 50, 4)), 3, axis=0)
    varied[..., 2] *= np.array([1.0, 2.0, 4.0])[:, None]
    varied[..., 3] = 2 * varied[..., 2]
    varied[..., 1] = 0.0
    assert choose_views(varied) == (2, 0)


def test_only_the_physics_differ_between_the_changes():
    spec = env_spec("pendulum")
    default = dict(spec.default_sim_params)
    physics = [default, *({**default, **row} for row in spec.sim_params.group("train"))]
    changes = collect_changes(spec, physics, 6, seed=0)
    assert changes.shape == (5, 6, 3)
    same = physics.index(physics[0], 1)
    np.testing.assert_allclose(changes[same], changes[0], atol=1e-6)
    assert (np.ptp(changes[1:, :, 2], axis=0) > 0).all()


def test_an_environment_may_state_neither_default_physics_nor_a_length(tmp_path, monkeypatch):
    bare = {"name": "bare", "default_sim_params": {}, "episode_length": 0}
    monkeypatch.setattr(task, "_registered", dict(task._registered))
    headway.register(dataclasses.replace(env_spec("pendulum"), **bare))
    assert plot_dynamics("bare", tmp_path / "bare.png").stat().st_size > 10_000


def test_names_of_observations_fit_the_environments():
    for name in BUILT_IN:
        spec = env_spec(name)
        size = spec.make_task(**spec.options).obs_size
        assert len(set(spec.obs_names)) == len(spec.obs_names) == size
