import numpy as np

from headway.report.dynamics import Changes, choose_views, collect_changes
from headway.report.obs_names import obs_names
from headway.task import env_names, env_spec


def test_the_views_are_the_numbers_that_tell_physics_apart():
    rng = np.random.default_rng(0)
    varied = np.repeat(rng.normal(size=(1, 50, 4)), 3, axis=0)
    varied[..., 2] *= np.array([1.0, 2.0, 4.0])[:, None]
    varied[..., 3] = 2 * varied[..., 2]
    varied[..., 1] = 0.0
    views = choose_views(Changes([], varied, varied[0]), ["a", "b", "c", "d"])
    assert [view.label for view in views] == [f"change of {name} in one step" for name in "ca"]
    assert views[0](varied).shape == (3, 50)


def test_only_the_physics_differ_between_the_changes():
    spec = env_spec("pendulum")
    changes = collect_changes(spec, 6, seed=0)
    assert changes.varied.shape == (4, 6, 3)
    default = changes.physics.index(dict(spec.default_sim_params))
    np.testing.assert_allclose(changes.varied[default], changes.default, atol=1e-6)
    velocity = changes.varied[..., 2]
    assert (np.ptp(velocity, axis=0) > 0).all()


def test_names_of_observations_fit_the_environments():
    for name in env_names():
        spec = env_spec(name)
        size = spec.make_task(**spec.options).obs_size
        names = obs_names(name, size)
        assert len(set(names)) == size
        assert not names[0].startswith("observation"), name
    assert len(obs_names("hopper", 11)) == 11
    assert obs_names("pendulum", 4)[0] == "observation[0]"
