import numpy as np

from headway.lab.dynamics import choose_views, collect_changes
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


def test_names_of_observations_fit_the_environments():
    for name in BUILT_IN:
        spec = env_spec(name)
        size = spec.make_task(**spec.options).obs_size
        assert len(set(spec.obs_names)) == len(spec.obs_names) == size
