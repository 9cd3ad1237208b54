"""The prior from the data: its most likely noise, and what it finds in known data."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import toys
from headway.planning.last_layer import foresight
from headway.planning.last_layer.evidence import Evidence
from headway.planning.last_layer.prior import fit_prior
from headway.planning.last_layer.residuals import Onlooker, Residuals

FEATURES, OBS, STEPS = 6, 2, 30


def episodes(ratio, noise_std, count=20, seed=0):
    """Episodes whose corrections are drawn from the prior that is assumed."""
    rng = np.random.default_rng(seed)
    rows = []
    for _ in range(count):
        features = rng.normal(size=(STEPS, FEATURES)) * np.geomspace(1.0, 0.1, FEATURES)
        weight = rng.normal(size=(FEATURES, OBS)) * np.sqrt(ratio) * noise_std
        error = rng.normal(size=(STEPS, OBS)) * noise_std
        rows.append((features, features @ weight + error))
    return rows


def test_the_noise_is_the_most_likely_one_of_jointly_gaussian_residuals():
    """Its σ² is the mean of rᵀK⁻¹r over all transitions, K = I + ρΦΦᵀ."""
    rows = episodes(2.0, np.array([0.1, 0.3]), count=3)
    wanted = 0.0
    for features, residual in rows:
        kernel = np.eye(STEPS) + 3.0 * features @ features.T
        wanted += (residual * np.linalg.solve(kernel, residual)).sum(0) / (3 * STEPS)
    np.testing.assert_allclose(Evidence.of(rows).noise(3.0), wanted, rtol=1e-9)


def test_it_is_fitted_per_member_and_ignores_the_labels_of_physics():
    trajectories = [toys.random_trajectory(12 + n, seed=n) for n in range(3)]
    model, statistics = toys.small_model(), toys.odd_statistics()
    settings = {"history_length": 3, "horizon": 30}
    found = fit_prior(model, toys.POINT, statistics, trajectories, **settings)
    assert found.ratio.shape == (2,)
    assert found.noise.shape == (2, 2)
    assert (np.asarray(found.noise) > 0).all()
    renamed = [dataclasses.replace(t, sim_params={"gain": 9.0}) for t in trajectories]
    again = fit_prior(model, toys.POINT, statistics, renamed, **settings)
    for x, y in zip(jax.tree.leaves(found), jax.tree.leaves(again), strict=True):
        np.testing.assert_array_equal(x, y)


def test_the_context_is_that_of_the_moment_after_the_transition():
    """As in acting, where a transition is learned from once the encoder has seen it."""
    trajectory, model = toys.random_trajectory(6), toys.small_model()
    statistics = toys.odd_statistics()
    onlooker = Onlooker(model, toys.POINT, statistics, 3)
    [seen] = onlooker.episodes([trajectory])
    episode, _ = toys.lay_out([trajectory])
    context = context_of(model, statistics, episode, 4)
    for member, one in enumerate(seen):
        np.testing.assert_allclose(one.features[3, -4:-1], context[member], rtol=1e-5)
        np.testing.assert_array_equal(one.features[:, -1], 1.0)


def context_of(model, statistics, episode, moment):
    """The context vector of every member at a moment of an episode."""
    history = episode.history(jnp.zeros(1, int), jnp.full(1, moment), 3)
    wide = jax.tree.map(lambda x: jnp.broadcast_to(x, (2, *x.shape)), history)
    return model.context(wide, statistics)[:, 0]


def test_what_lies_ahead_is_seen_with_the_context_of_the_moment():
    trajectory, model = toys.random_trajectory(6), toys.small_model()
    statistics = toys.odd_statistics()
    onlooker = Onlooker(model, toys.POINT, statistics, 3)
    [(before, after)] = onlooker.from_moments([trajectory], [[4]])
    [whole] = onlooker.episodes([trajectory])
    context = context_of(model, statistics, toys.lay_out([trajectory])[0], 4)
    for member, (learned, later) in enumerate(zip(before, after, strict=True)):
        assert learned.head == later.head
        np.testing.assert_array_equal(learned.features, whole[member].features[:4])
        assert len(later.features) == 2
        for row in later.features:
            np.testing.assert_allclose(row[-4:-1], context[member], rtol=1e-5)


def residuals(features, residual):
    return Residuals(features, residual, 0)


@pytest.mark.parametrize("steps", [3, 5])  # fewer than features, and more
def test_errors_ahead_are_those_of_regression(steps):
    rng = np.random.default_rng(0)
    features, residual = rng.normal(size=(9, 4)), rng.normal(size=(9, 2))
    root, one = rng.normal(size=(4, 4)), residuals(features, residual)
    learned, later = one.part(slice(steps)), one.part(slice(steps, None))
    for ratio, error in zip(
        foresight.RATIOS, foresight.errors_ahead(learned, later, root), strict=True
    ):
        precision = np.linalg.inv(ratio * root @ root.T)
        gram = features[:steps].T @ features[:steps] + precision
        weight = np.linalg.solve(gram, features[:steps].T @ residual[:steps])
        left = residual[steps:] - features[steps:] @ weight
        assert error == pytest.approx(np.square(left).mean(), rel=1e-4)


@pytest.mark.parametrize("power", foresight.POWERS)
def test_directions_are_spread_by_how_much_they_vary(power):
    rng = np.random.default_rng(0)
    turn, _ = np.linalg.qr(rng.normal(size=(3, 3)))
    rows = [residuals(rng.normal(size=(40, 3)) @ turn.T * [1.0, 0.1, 3.0], np.zeros((40, 1)))]
    [found] = foresight.directions_of([rows, rows])
    moment = rows[0].features.T @ rows[0].features / 40
    root = found.root(power)
    np.testing.assert_allclose(root @ found.inverse(power), np.eye(3), atol=1e-9)
    values, vectors = np.linalg.eigh(moment)
    shape = vectors @ np.diag(values**-power) @ vectors.T
    expected = shape / np.trace(shape @ moment)
    np.testing.assert_allclose(root @ root.T, expected, rtol=1e-6, atol=1e-12)


def test_directions_that_never_vary_have_a_floor():
    found = foresight.Directions.of(np.diag([1.0, 0.0]))
    assert np.isfinite(found.root(1.0)).all()


def foreseen_best(rows, horizon=10):
    """The ratio that foresight takes for some episodes of one member."""
    cut, known = [], [[residuals(features, residual)] for features, residual in rows]
    for i, [one] in enumerate(known):
        for moment in foresight.moments_of(STEPS, i):
            cut.append(([one.part(slice(moment))], [one.part(slice(moment, None))]))
    directions = foresight.directions_of(known)
    return foresight.best([foresight.relative_errors(cut, directions, horizon)])


@pytest.mark.parametrize("ratio", [0.01, 1.0, 300.0])
def test_foresight_finds_about_the_prior_that_made_the_data(ratio):
    rows = episodes(ratio, 0.1, count=200, seed=1)
    power, found = foreseen_best(rows)
    scale = np.mean([np.square(features).sum(-1) for features, _ in rows])
    assert power == 0.0
    assert ratio / 5 < found / scale < ratio * 5


def test_what_explains_an_episode_but_predicts_nothing_is_not_trusted():
    """Features and errors that hold for some steps and are then others: all is explained."""
    rng = np.random.default_rng(0)
    rows = []
    for _ in range(20):
        features, residual = rng.normal(size=(15, 40)), rng.normal(size=(15, OBS))
        held = (np.repeat(x, 2, axis=0) for x in (features, residual))
        rows.append(tuple(held))
    assert foreseen_best(rows)[1] < 1.0


def test_both_heads_count_in_units_of_their_own_errors():
    owner, runner_up = np.full((2, *np.shape(foresight.RATIOS)), 2.0)[:, None]
    owner[0, 3], runner_up[0, 7], owner[0, 9], runner_up[0, 9] = 0.9, 0.8, 1.0, 0.5
    assert foresight.best([owner]) == (0.0, foresight.RATIOS[3])
    assert foresight.best([runner_up]) == (0.0, foresight.RATIOS[9])
    assert foresight.best([owner, runner_up]) == (0.0, foresight.RATIOS[9])


def test_moments_are_log_uniform_and_leave_something_to_foresee():
    found = np.array([foresight.moments_of(200, i) for i in range(1000)])
    assert found.min() == 1
    assert found.max() == 199
    assert np.mean(found < 200**0.5) == pytest.approx(0.5, abs=0.02)
    assert np.mean(found < 200**0.25) == pytest.approx(0.25, abs=0.05)
    assert foresight.moments_of(2, 0) == [1] * foresight.MOMENTS
    assert foresight.moments_of(1, 0) == []
