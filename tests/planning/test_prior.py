"""The prior from the data: the likelihood it maximises, and what it finds in known data."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import toys
from headway.planning.last_layer import prior as prior_module
from headway.planning.last_layer.prior import Evidence, fit_prior

FEATURES, OBS, STEPS = 6, 2, 30


def episodes(ratio, noise_std, count=20, seed=0):
    """Episodes whose corrections are drawn from the prior that is assumed."""
    rng = np.random.default_rng(seed)
    rows = []
    for _ in range(count):
        features = rng.normal(size=(STEPS, FEATURES)) * np.geomspace(1.0, 0.1, FEATURES)
        relative = rng.uniform(0.5, 2.0, STEPS)
        weight = rng.normal(size=(FEATURES, OBS)) * np.sqrt(ratio) * noise_std
        error = rng.normal(size=(STEPS, OBS)) * noise_std * np.sqrt(relative)[:, None]
        rows.append((features, features @ weight + error, relative))
    return rows


def test_the_likelihood_is_that_of_jointly_gaussian_residuals():
    ratio, rows = 3.0, episodes(2.0, np.array([0.1, 0.3]), count=3)
    evidence = Evidence.of(rows)
    noise, total = evidence.noise(ratio), 0.0
    for features, residual, relative in rows:
        kernel = np.diag(relative) + ratio * features @ features.T
        for o in range(OBS):
            covariance = noise[o] * kernel
            quadratic = residual[:, o] @ np.linalg.solve(covariance, residual[:, o])
            total -= 0.5 * (quadratic + np.linalg.slogdet(2 * np.pi * covariance)[1])
    assert evidence.log_likelihood(ratio) == pytest.approx(total, rel=1e-9)


@pytest.mark.parametrize("ratio", [0.01, 1.0, 300.0])
def test_it_finds_the_prior_that_made_the_data(ratio):
    noise_std = np.array([0.1, 0.3])
    evidence = Evidence.of(episodes(ratio, noise_std, count=60))
    found = evidence.best_ratio()
    assert ratio / 2 < found < ratio * 2
    np.testing.assert_allclose(np.sqrt(evidence.noise(found)), noise_std, rtol=0.1)


def test_it_is_fitted_per_member_and_ignores_the_labels_of_physics():
    trajectories = [toys.random_trajectory(12 + n, seed=n) for n in range(3)]
    model, statistics = toys.small_model(), toys.odd_statistics()
    found = fit_prior(model, toys.POINT, statistics, trajectories, history_length=3)
    assert found.ratio.shape == (2,)
    assert found.noise.shape == (2, 2)
    assert (np.asarray(found.noise) > 0).all()
    renamed = [dataclasses.replace(t, sim_params={"gain": 9.0}) for t in trajectories]
    again = fit_prior(model, toys.POINT, statistics, renamed, history_length=3)
    for x, y in zip(found, again, strict=True):
        np.testing.assert_array_equal(x, y)


def test_the_runner_up_leaves_more_to_learn_than_the_owner():
    """Two heads, one of which is exactly right: only the other one's errors need correcting."""
    model = toys.linear_model([[np.eye(2), -np.eye(2)], [-np.eye(2), np.eye(2)]])
    trajectories = [toys.random_trajectory(20, seed=n) for n in range(3)]
    found = {
        rank: fit_prior(
            model,
            toys.POINT,
            toys.identity_statistics(),
            trajectories,
            history_length=3,
            rank=rank,
        )
        for rank in ("owner", "runner-up")
    }
    spread = {
        rank: np.asarray(prior.ratio)[:, None] * np.asarray(prior.noise)
        for rank, prior in found.items()
    }
    assert (spread["runner-up"] > 1e3 * spread["owner"]).all()


def test_the_context_is_that_of_the_moment_after_the_transition():
    """As in acting, where a transition is learned from once the encoder has seen it."""
    trajectory, model = toys.random_trajectory(6), toys.small_model()
    statistics = toys.odd_statistics()
    episode, _ = toys.lay_out([trajectory])
    seen = prior_module._look(model, toys.POINT, statistics, episode, 3)
    history = episode.history(jnp.zeros(1, int), jnp.full(1, 4), 3)
    wide = jax.tree.map(lambda x: jnp.broadcast_to(x, (2, *x.shape)), history)
    context = model.context(wide, statistics)
    np.testing.assert_allclose(seen.features[3, :, -4:-1], context[:, 0], rtol=1e-5)
    np.testing.assert_array_equal(seen.features[:, :, -1], 1.0)
