"""The prior from the training data: what it sees of them, and what it finds in known data."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import toys
from headway.errors import ConfigError
from headway.models import last_layer_prior
from headway.models.last_layer_prior import (
    POWERS,
    RATIOS,
    fit_prior,
    residuals_of,
    spread_root,
    validation_errors,
    validation_moments,
    whitened_squares,
)

STEPS, HISTORY = 30, 3
SETTINGS = {"history_length": HISTORY, "horizon": 10}


def test_it_is_fitted_per_member_and_ignores_the_labels_of_physics():
    trajectories = [toys.random_trajectory(12 + n, seed=n) for n in range(3)]
    args = toys.small_model(), toys.POINT, toys.odd_statistics()
    found = fit_prior(*args, trajectories, **SETTINGS)
    assert found.root.shape == (2, 12, 12)
    assert found.noise.shape == (2, 2)
    assert (np.asarray(found.noise) > 0).all()
    assert np.abs(found.root[0] - found.root[1]).max() > 0
    renamed = [dataclasses.replace(t, sim_params={"gain": 9.0}) for t in trajectories]
    for x, y in zip(found, fit_prior(*args, renamed, **SETTINGS), strict=True):
        np.testing.assert_array_equal(x, y)


def test_a_prior_needs_episodes():
    args = toys.small_model(), toys.POINT, toys.identity_statistics()
    with pytest.raises(ConfigError, match="no training episodes"):
        fit_prior(*args, [], **SETTINGS)


@pytest.mark.parametrize("moments", [[1, 2, 3, 4, 5, 6], [4] * 6], ids=["acting", "a moment"])
def test_each_transition_is_seen_with_the_context_of_a_moment(moments):
    model, statistics = toys.small_model(), toys.odd_statistics()
    episode, _ = toys.lay_out([toys.random_trajectory(6)])
    args = model, toys.POINT, statistics, episode, jnp.asarray(moments), HISTORY
    features = np.asarray(residuals_of(*args).features)
    for step, moment in enumerate(moments):
        history = episode.history(jnp.zeros(1, int), jnp.full(1, moment), HISTORY)
        wide = jax.tree.map(lambda x: jnp.broadcast_to(x, (2, *x.shape)), history)
        context = model.context(wide, statistics)[:, 0]
        np.testing.assert_allclose(features[step, :, -4:-1], context, rtol=1e-5)
    np.testing.assert_array_equal(features[..., -1], 1.0)


@pytest.mark.parametrize("steps", [3, 5])  # fewer than features, and more
def test_validation_errors_are_those_of_regression(steps):
    rng = np.random.default_rng(0)
    features, residual = rng.normal(size=(9, 4)), rng.normal(size=(9, 2, 3))
    root = rng.normal(size=(4, 4))
    learned, later = ((features[part], residual[part]) for part in np.split(np.arange(9), [steps]))
    found = validation_errors(learned, later, root)
    for ratio, errors in zip(RATIOS, found, strict=True):
        gram = learned[0].T @ learned[0] + np.linalg.inv(ratio * root @ root.T)
        for head in range(2):
            weight = np.linalg.solve(gram, learned[0].T @ learned[1][:, head])
            left = later[1][:, head] - later[0] @ weight
            assert errors[head] == pytest.approx(np.square(left).mean(), rel=1e-4)


def test_the_noise_is_the_most_likely_one_of_jointly_gaussian_residuals():
    rng = np.random.default_rng(0)
    features, residual = rng.normal(size=(STEPS, 6)), rng.normal(size=(STEPS, 2))
    kernel = np.eye(STEPS) + features @ features.T
    wanted = (residual * np.linalg.solve(kernel, residual)).sum(0)
    np.testing.assert_allclose(whitened_squares(features, residual), wanted, rtol=1e-9)


@pytest.mark.parametrize("power", POWERS)
def test_the_prior_is_spread_by_how_much_features_vary(power):
    rng = np.random.default_rng(0)
    features = rng.normal(size=(40, 3)) @ rng.normal(size=(3, 3)) * [1.0, 0.1, 3.0]
    moment = features.T @ features / 40
    values, vectors = np.linalg.eigh(moment)
    shape = vectors @ np.diag(values**-power) @ vectors.T
    root = spread_root(moment, power)
    np.testing.assert_allclose(
        root @ root.T, shape / np.trace(shape @ moment), rtol=1e-6, atol=1e-12
    )
    assert np.isfinite(spread_root(np.diag([1.0, 0.0]), power)).all()


def fitted_to(episodes, monkeypatch):
    """The prior of one member and head whose features and residuals are given."""
    model = toys.linear_model([[np.eye(2)]])
    trajectories = [
        dataclasses.replace(toys.random_trajectory(len(residual)), sim_params={"gain": float(i)})
        for i, (_, residual) in enumerate(episodes)
    ]

    def residuals_of(*args):
        features, residual = episodes[int(args[3].sim_params[0, 0])]
        return last_layer_prior.Residuals(features[:, None], residual[:, None, None])

    monkeypatch.setattr(last_layer_prior, "residuals_of", residuals_of)
    model = dataclasses.replace(model, sim_param_names=("gain",))
    return fit_prior(model, toys.POINT, toys.identity_statistics(), trajectories, **SETTINGS)


@pytest.mark.parametrize("ratio", [0.1, 1.0, 300.0])
def test_it_finds_about_the_prior_that_made_the_data(ratio, monkeypatch):
    rng, noise_std = np.random.default_rng(1), np.array([0.1, 0.3])
    episodes = []
    for _ in range(60):
        features = rng.normal(size=(STEPS, 6)) * np.geomspace(1.0, 0.1, 6)
        weight = rng.normal(size=(6, 2)) * np.sqrt(ratio) * noise_std
        error = rng.normal(size=(STEPS, 2)) * noise_std
        episodes.append((features, features @ weight + error))
    root, noise = fitted_to(episodes, monkeypatch)
    found = np.diag(root[0] @ root[0].T)
    assert (found > ratio / 5).all()
    assert (found < ratio * 5).all()
    np.testing.assert_allclose(np.sqrt(noise[0]), noise_std, rtol=0.1)


def test_what_explains_an_episode_but_predicts_nothing_is_not_trusted(monkeypatch):
    """Features and errors that hold for some steps and are then others: all can be explained."""
    rng = np.random.default_rng(0)
    episodes = [
        tuple(np.repeat(rng.normal(size=(15, size)), 2, axis=0) for size in (40, 2))
        for _ in range(20)
    ]
    root, _ = fitted_to(episodes, monkeypatch)
    assert np.trace(root[0] @ root[0].T) < 1.0


def test_moments_are_log_uniform_and_leave_something_to_predict():
    found = np.array([validation_moments(200, i) for i in range(1000)])
    assert found.min() == 1
    assert found.max() == 199
    assert np.mean(found < 200**0.5) == pytest.approx(0.5, abs=0.02)
    assert np.mean(found < 200**0.25) == pytest.approx(0.25, abs=0.05)
    assert validation_moments(2, 0) == [1] * last_layer_prior.MOMENTS
    assert validation_moments(1, 0) == []
