"""The regression of the last layer: exact against NumPy in float64, safe, bounded."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import stats

from headway.planning.last_layer.regression import (
    NOISE_DOF,
    LastLayer,
    Observed,
    Prior,
    Seen,
    Shape,
    credence,
    forecast,
    log_likelihood,
    update,
)

ENVS, MEMBERS, HEADS, FEATURES, OBS = 2, 2, 3, 12, 2


def some_prior(ratio=0.5, *, shaped=False):
    """A prior with other numbers for each member; shaped, its weights are correlated too."""
    shape, rng = None, np.random.default_rng(7)
    if shaped:
        turn, _ = np.linalg.qr(rng.normal(size=(MEMBERS, FEATURES, FEATURES)))
        roots = turn * np.geomspace(0.1, 2.0, FEATURES)
        shape = Shape(*(jnp.asarray(x, jnp.float32) for x in (roots, np.linalg.inv(roots))))
    ratios = jnp.asarray([ratio, 2.0 * ratio])
    return Prior(ratios, jnp.asarray([[0.1, 0.2], [0.3, 0.4]]), shape)


def prior_covariance(prior, member):
    """Of one member, over the noise variance, in float64."""
    root = np.eye(FEATURES)
    if prior.shape is not None:
        root = np.asarray(prior.shape.root[member], np.float64)
    return float(prior.ratio[member]) * root @ root.T


def some_transitions(steps, seed=0):
    """Transitions [step, env, ...] whose features are correlated and of unequal sizes."""
    rng = np.random.default_rng(seed)
    mixing = rng.normal(size=(FEATURES, FEATURES)) * np.geomspace(1.0, 0.01, FEATURES)
    features = rng.normal(size=(steps, ENVS, MEMBERS, FEATURES)) @ mixing
    features[..., -1] = 1.0
    truth = rng.normal(size=(ENVS, MEMBERS, HEADS, FEATURES, OBS))
    residual = np.einsum("semi,emhio->semho", features, truth)
    residual += 0.1 * rng.normal(size=residual.shape)
    noise = rng.uniform(1.0, 3.0, (steps, ENVS, MEMBERS, 1))
    return Observed(*(jnp.asarray(x, jnp.float32) for x in (features, residual, noise)))


@jax.jit
def learn_all(state, transitions):
    def step(state, seen):
        return update(state, seen, forecast(state, seen)), None

    return jax.lax.scan(step, state, transitions)[0]


def fresh(prior):
    return LastLayer.of_prior(prior, ENVS, (HEADS, FEATURES, OBS))


def batch_posterior(prior, transitions, env, member, head):
    """Mean and covariance (over the noise variance) of Bayesian linear regression, float64."""
    f, r, n = (np.asarray(x, np.float64)[:, env, member] for x in transitions)
    whitened = f / n
    precision = np.linalg.inv(prior_covariance(prior, member)) + whitened.T @ f
    return np.linalg.solve(precision, whitened.T @ r[:, head]), np.linalg.inv(precision)


@pytest.mark.parametrize("shaped", [False, True])
def test_a_thousand_updates_equal_batch_regression_in_float64(shaped):
    prior, transitions = some_prior(shaped=shaped), some_transitions(1000)
    state = learn_all(fresh(prior), transitions)
    for env, member, head in np.ndindex(ENVS, MEMBERS, HEADS):
        mean, covariance = batch_posterior(prior, transitions, env, member, head)
        np.testing.assert_allclose(state.weight[env, member, head], mean, atol=1e-5)
        root = np.asarray(state.root, np.float64)[env, member, 0]
        np.testing.assert_allclose(root @ root.T, covariance, atol=1e-5)


@pytest.mark.parametrize("shaped", [False, True])
def test_a_prior_of_zero_never_learns(shaped):
    prior = some_prior(0.0, shaped=shaped)
    state = learn_all(fresh(prior), some_transitions(50))
    assert not np.asarray(state.weight).any()
    assert not np.asarray(state.root).any()


@pytest.mark.parametrize("shaped", [False, True])
def test_a_hundred_thousand_updates_stay_finite_and_within_the_prior(shaped):
    prior = some_prior(1e5, shaped=shaped)
    transitions = some_transitions(1000)
    transitions = transitions._replace(features=30.0 * transitions.features)

    def again(_, state):
        return learn_all(state, transitions)

    state = jax.jit(lambda state: jax.lax.fori_loop(0, 100, again, state))(fresh(prior))
    assert np.isfinite(state.weight).all()
    covariance = np.asarray(state.root @ state.root.mT)
    largest = [np.diag(prior_covariance(prior, member)) for member in range(MEMBERS)]
    diagonal = np.diagonal(covariance, axis1=-2, axis2=-1)[:, :, 0]
    assert (diagonal > 0).all()
    assert (diagonal <= largest).all()
    residual = np.asarray(forecast(state, jax.tree.map(lambda x: x[0], transitions)).innovation)
    assert np.square(residual).mean() < 0.1


@pytest.mark.parametrize("steps", [0, 6])
def test_likelihood_is_that_of_regression_with_unknown_noise(steps):
    """Student's t, against the ratio of marginal likelihoods of n + 1 and n transitions."""
    prior, transitions = some_prior(shaped=True), some_transitions(steps + 1)
    before, last = (jax.tree.map(lambda x, part=part: x[part], transitions)
                    for part in (slice(steps), steps))  # fmt: skip
    state = learn_all(fresh(prior), before)
    found = log_likelihood(forecast(state, last), state, prior)
    f, r, n = (np.asarray(x, np.float64) for x in transitions)
    for env, member, head in np.ndindex(ENVS, MEMBERS, HEADS):
        rows = f[:, env, member]
        kernel = rows @ prior_covariance(prior, member) @ rows.T + np.diag(n[:, env, member, 0])
        expected = 0.0
        for o in range(OBS):
            scale = NOISE_DOF * float(prior.noise[member, o])
            errors = r[:, env, member, head, o]
            whole, part = (
                stats.multivariate_t(
                    shape=scale / NOISE_DOF * kernel[:k, :k], df=NOISE_DOF
                ).logpdf(errors[:k]) if k else 0.0
                for k in (steps + 1, steps)
            )  # fmt: skip
            expected += whole - part
        assert found[env, member, head] == pytest.approx(expected, rel=1e-3, abs=1e-2)


def test_a_transition_is_believed_as_the_slope_of_its_likelihood_says():
    """A Gaussian error x pulls by x / var; under Student's t it pulls by a share of that."""
    prior, transitions = some_prior(shaped=True), some_transitions(9)
    before, last = (jax.tree.map(lambda x, part=part: x[part], transitions)
                    for part in (slice(8), 8))  # fmt: skip
    state = learn_all(fresh(prior), before)
    expected = forecast(state, last)
    var = expected.spread[..., None] * state.noise(prior)
    errors = jnp.asarray([1.5, 4.0, 60.0])[:HEADS, None]  # in deviations, alike in all dimensions
    expected = expected._replace(innovation=errors * jnp.sqrt(var))
    slope = jax.grad(lambda x: log_likelihood(expected._replace(innovation=x), state, prior).sum())(
        expected.innovation
    )
    share = np.asarray(-slope * var / expected.innovation)[..., 0]
    share = share.max(-1, keepdims=True)
    np.testing.assert_allclose(credence(expected, state, prior), share, rtol=1e-4)
    near = expected._replace(innovation=0.9 * jnp.sqrt(var))
    np.testing.assert_array_equal(credence(near, state, prior), 1.0)


def test_transitions_that_cannot_be_true_teach_nothing():
    """Each of one member's, in one environment, is spoilt in another way."""
    features, residual, _ = (x[0] for x in some_transitions(1))
    seen, happened = Seen(features, residual, None), jnp.ones(ENVS, bool)
    spoilt = {
        "all heads far off": seen._replace(residual=residual.at[0, 1, :, 0].set(-1e4)),
        "unknown": seen._replace(residual=residual.at[0, 1].set(jnp.nan)),
        "huge": seen._replace(features=features.at[0, 1, 2].set(1e5)),
        "unknown features": seen._replace(features=features.at[0, 1, 2].set(jnp.nan)),
    }
    for what, each in spoilt.items():
        found = Observed.of(each, happened)
        assert np.asarray(found.learned_from).tolist() == [[1, 0], [1, 1]], what
        assert not np.asarray(found.features[0, 1]).any()
        assert not np.asarray(found.residual[0, 1]).any()
        np.testing.assert_array_equal(found.residual[1], residual[1])
    not_yet = Observed.of(seen, jnp.asarray([False, True]))
    assert np.asarray(not_yet.learned_from).tolist() == [[0, 0], [1, 1]]


@pytest.mark.parametrize(("value", "taken"), [(1e4, 100.0), (-1e4, -100.0), (np.nan, 100.0)])
def test_a_head_that_is_absurd_alone_keeps_the_others_from_nothing(value, taken):
    features, residual, _ = (x[0] for x in some_transitions(1))
    seen = Seen(features, residual.at[0, 1, 0].set(value), None)
    found = Observed.of(seen, jnp.ones(ENVS, bool))
    assert (np.asarray(found.learned_from) == 1).all()
    np.testing.assert_array_equal(found.residual[0, 1, 1:], residual[0, 1, 1:])
    assert (np.asarray(found.residual[0, 1, 0]) == taken).all()


def test_what_cannot_be_learned_from_counts_for_nothing():
    prior, transitions = some_prior(), some_transitions(3)
    state = learn_all(fresh(prior), transitions)
    nothing = Observed(*(jnp.zeros_like(x[0]) for x in transitions[:2]), transitions.noise[0])
    after = update(state, nothing, forecast(state, nothing))
    for x, y in zip(state, after, strict=True):
        np.testing.assert_array_equal(x, y)
