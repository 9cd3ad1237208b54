"""The prior from the data: the likelihood it maximises, and what it finds in known data."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import toys
from headway.config import PlannerConfig
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


@pytest.mark.parametrize("criterion", ["likelihood", "foresight"])
def test_it_is_fitted_per_member_and_ignores_the_labels_of_physics(criterion):
    trajectories = [toys.random_trajectory(12 + n, seed=n) for n in range(3)]
    model, statistics = toys.small_model(), toys.odd_statistics()
    planner = PlannerConfig(adaptation_criterion=criterion)
    settings = {"history_length": 3, "planner": planner}
    found = fit_prior(model, toys.POINT, statistics, trajectories, **settings)
    assert found.ratio.shape == (2,)
    assert found.noise.shape == (2, 2)
    assert (np.asarray(found.noise) > 0).all()
    renamed = [dataclasses.replace(t, sim_params={"gain": 9.0}) for t in trajectories]
    again = fit_prior(model, toys.POINT, statistics, renamed, **settings)
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
            planner=PlannerConfig(adaptation_prior=rank),
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
    return Residuals(features, residual, np.zeros(len(features)), 0)


@pytest.mark.parametrize("steps", [3, 5])  # fewer than features, and more
@pytest.mark.parametrize("reference", [None, -1.0])
def test_errors_ahead_are_those_of_regression(steps, reference):
    rng = np.random.default_rng(0)
    features, residual = rng.normal(size=(9, 4)), rng.normal(size=(9, 2))
    root, logvar = rng.normal(size=(4, 4)), rng.normal(size=9)
    one = Residuals(features, residual, logvar, 0)
    learned, later = one.part(slice(steps)), one.part(slice(steps, None))
    noise = np.ones(steps) if reference is None else np.exp(logvar[:steps] - reference)
    for ratio, error in zip(
        foresight.RATIOS, foresight.errors_ahead(learned, later, root, reference), strict=True
    ):
        precision = np.linalg.inv(ratio * root @ root.T)
        gram = (features[:steps] / noise[:, None]).T @ features[:steps] + precision
        weight = np.linalg.solve(gram, features[:steps].T @ (residual[:steps] / noise[:, None]))
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
    cut, known = [], [[residuals(features, residual)] for features, residual, _ in rows]
    for i, [one] in enumerate(known):
        for moment in foresight.moments_of(STEPS, i):
            cut.append(([one.part(slice(moment))], [one.part(slice(moment, None))]))
    directions = foresight.directions_of(known)
    return foresight.best([foresight.relative_errors(cut, directions, horizon, [None])])


@pytest.mark.parametrize("ratio", [0.01, 1.0, 300.0])
def test_foresight_finds_about_the_prior_that_made_the_data(ratio):
    rows = episodes(ratio, 0.1, count=60)
    power, found = foreseen_best(rows)
    scale = np.mean([np.square(features).sum(-1) for features, _, _ in rows])
    assert power == 0.0
    assert ratio / 5 < found / scale < ratio * 5


def test_what_explains_an_episode_but_predicts_nothing_is_not_trusted():
    """Features and errors that hold for some steps and are then others: all is explained."""
    rng = np.random.default_rng(0)
    rows = []
    for _ in range(20):
        features, residual = rng.normal(size=(15, 40)), rng.normal(size=(15, OBS))
        held = (np.repeat(x, 2, axis=0) for x in (features, residual))
        rows.append((*held, np.ones(STEPS)))
    assert Evidence.of(rows).best_ratio() > 1e3
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
