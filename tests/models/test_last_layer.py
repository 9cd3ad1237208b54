"""The regression of the last layer: exact against NumPy in float64, safe, bounded."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import stats

from headway.models.last_layer import (
    NOISE_DOF,
    LastLayer,
    Prior,
    Residuals,
    innovate,
    log_likelihood,
    observe,
    robust_weight,
    update,
)

ENVS, MEMBERS, HEADS, FEATURES, OBS = 2, 2, 3, 12, 2
HERE = jnp.ones(ENVS, bool)


def some_prior(ratio=0.5):
    """Correlated weights of unequal uncertainty, others for each member."""
    rng = np.random.default_rng(7)
    turn, _ = np.linalg.qr(rng.normal(size=(MEMBERS, FEATURES, FEATURES)))
    roots = (
        turn * np.geomspace(0.1, 2.0, FEATURES) * np.sqrt(ratio * np.arange(1, 3))[:, None, None]
    )
    return Prior(jnp.asarray(roots, jnp.float32), jnp.asarray([[0.1, 0.2], [0.3, 0.4]]))


def prior_covariance(prior, member):
    """Of one member, over the noise variance, in float64."""
    root = np.asarray(prior.root[member], np.float64)
    return root @ root.T


def some_transitions(steps, seed=0):
    """Transitions [step, env, ...] whose features are correlated and of unequal sizes."""
    rng = np.random.default_rng(seed)
    mixing = rng.normal(size=(FEATURES, FEATURES)) * np.geomspace(1.0, 0.01, FEATURES)
    features = rng.normal(size=(steps, ENVS, MEMBERS, FEATURES)) @ mixing
    features[..., -1] = 1.0
    truth = rng.normal(size=(ENVS, MEMBERS, HEADS, FEATURES, OBS))
    residual = np.einsum("semi,emhio->semho", features, truth)
    residual += 0.1 * rng.normal(size=residual.shape)
    return Residuals(jnp.asarray(features, jnp.float32), jnp.asarray(residual, jnp.float32))


def at(transitions, part):
    return jax.tree.map(lambda x: x[part], transitions)


@jax.jit
def learn_all(layer, transitions, noise=None):
    def step(layer, now):
        return update(layer, *now), None

    if noise is None:
        noise = jnp.ones(transitions.features.shape[:-1])
    return jax.lax.scan(step, layer, (transitions, noise))[0]


def fresh(prior):
    return LastLayer.init(prior, ENVS, HEADS)


def test_a_thousand_updates_equal_batch_regression_in_float64():
    prior, transitions = some_prior(), some_transitions(1000)
    noise = np.random.default_rng(1).uniform(1.0, 3.0, (1000, ENVS, MEMBERS))
    layer = learn_all(fresh(prior), transitions, jnp.asarray(noise, jnp.float32))
    for env, member, head in np.ndindex(ENVS, MEMBERS, HEADS):
        f, r = (np.asarray(x, np.float64)[:, env, member] for x in transitions[:2])
        whitened = f / noise[:, env, member, None]
        precision = np.linalg.inv(prior_covariance(prior, member)) + whitened.T @ f
        mean = np.linalg.solve(precision, whitened.T @ r[:, head])
        np.testing.assert_allclose(layer.weight[env, member, head], mean, atol=1e-5)
        root = np.asarray(layer.root, np.float64)[env, member]
        np.testing.assert_allclose(root @ root.T, np.linalg.inv(precision), atol=1e-5)


def test_a_hundred_thousand_updates_stay_finite_and_within_the_prior():
    prior, transitions = some_prior(1e5), some_transitions(1000)
    transitions = transitions._replace(features=30.0 * transitions.features)

    def again(_, layer):
        return learn_all(layer, transitions)

    layer = jax.jit(lambda layer: jax.lax.fori_loop(0, 100, again, layer))(fresh(prior))
    assert np.isfinite(layer.weight).all()
    covariance = np.asarray(layer.root @ layer.root.mT)
    largest = [np.diag(prior_covariance(prior, member)) for member in range(MEMBERS)]
    diagonal = np.diagonal(covariance, axis1=-2, axis2=-1)
    assert (diagonal > 0).all()
    assert (diagonal <= largest).all()
    assert np.square(innovate(layer, at(transitions, 0)).error).mean() < 0.1


@pytest.mark.parametrize("steps", [0, 6])
def test_likelihood_is_that_of_regression_with_unknown_noise(steps):
    """Student's t, against the ratio of marginal likelihoods of n + 1 and n transitions."""
    prior, transitions = some_prior(), some_transitions(steps + 1)
    layer = learn_all(fresh(prior), at(transitions, slice(steps)))
    found = log_likelihood(layer, prior, at(transitions, steps))
    f, r = (np.asarray(x, np.float64) for x in transitions[:2])
    for env, member, head in np.ndindex(ENVS, MEMBERS, HEADS):
        rows = f[:, env, member]
        kernel = rows @ prior_covariance(prior, member) @ rows.T + np.eye(steps + 1)
        expected = 0.0
        for o in range(OBS):
            errors = r[:, env, member, head, o]
            whole, part = (
                stats.multivariate_t(
                    shape=float(prior.noise[member, o]) * kernel[:k, :k], df=NOISE_DOF
                ).logpdf(errors[:k]) if k else 0.0
                for k in (steps + 1, steps)
            )  # fmt: skip
            expected += whole - part
        assert found[env, member, head] == pytest.approx(expected, rel=1e-3, abs=1e-2)


def test_an_outlier_weighs_as_the_slope_of_its_likelihood_says():
    """A Gaussian error x pulls by x / var; under Student's t it pulls by a share of that."""
    prior, transitions = some_prior(), some_transitions(9)
    layer, last = learn_all(fresh(prior), at(transitions, slice(8))), at(transitions, 8)
    innovation, _, variance = innovate(layer, last)
    noise = (NOISE_DOF * prior.noise[:, None] + layer.squares) / (NOISE_DOF + 8)
    var = (1 + variance)[..., None, None] * noise

    def off_by(deviations):  # alike in all dimensions
        return last._replace(residual=last.residual - innovation + deviations * jnp.sqrt(var))

    errors = jnp.asarray([1.5, 4.0, 60.0])[:, None]
    far = off_by(errors)
    slope = jax.grad(lambda x: log_likelihood(layer, prior, far._replace(residual=x)).sum())(
        far.residual
    )
    share = np.asarray(-slope * var / (errors * jnp.sqrt(var)))[..., 0].max(-1)
    np.testing.assert_allclose(robust_weight(layer, prior, far), share, rtol=1e-3)
    np.testing.assert_array_equal(robust_weight(layer, prior, off_by(0.9)), 1.0)


def test_transitions_that_cannot_be_true_teach_nothing():
    """Each of one member's, in one environment, is spoilt in another way."""
    seen, layer = at(some_transitions(1), 0), fresh(some_prior())
    features, residual, _ = seen
    spoilt = {
        "all heads far off": seen._replace(residual=residual.at[0, 1, :, 0].set(-1e4)),
        "unknown": seen._replace(residual=residual.at[0, 1].set(jnp.nan)),
        "huge": seen._replace(features=features.at[0, 1, 2].set(1e5)),
        "unknown features": seen._replace(features=features.at[0, 1, 2].set(jnp.nan)),
    }
    for what, each in spoilt.items():
        found = observe(layer, some_prior(), each, HERE, change_threshold=20.0)
        assert np.asarray(found.count).tolist() == [[1, 0], [1, 1]], what
        assert not np.asarray(found.weight[0, 1]).any()
        np.testing.assert_array_equal(found.root[0, 1], layer.root[0, 1])
        assert np.isfinite(found.cusum).all()
    not_yet = observe(layer, some_prior(), seen, jnp.asarray([False, True]))
    assert np.asarray(not_yet.count).tolist() == [[0, 0], [1, 1]]
    for before, after in zip(layer, not_yet, strict=True):
        np.testing.assert_array_equal(before[0], after[0])


@pytest.mark.parametrize(("value", "taken"), [(1e4, 100.0), (-1e4, -100.0), (np.nan, 100.0)])
def test_a_head_that_is_absurd_alone_keeps_the_others_from_nothing(value, taken):
    seen = at(some_transitions(1), 0)
    found = seen._replace(residual=seen.residual.at[0, 1, 0].set(value)).gated(HERE)
    assert (np.asarray(found.features[..., -1]) == 1).all()
    np.testing.assert_array_equal(found.residual[0, 1, 1:], seen.residual[0, 1, 1:])
    assert (np.asarray(found.residual[0, 1, 0]) == taken).all()
