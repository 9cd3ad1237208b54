"""iCEM: against a NumPy twin; its memory, its shrinking population, its choice of the best."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from search_helpers import ACTIONS, HORIZON, KEY, NUM_ENVS, begin, start, towards, watch

from headway.planning.optimizers import ICEM, SearchState
from headway.planning.optimizers.noise import colored_noise

AIMS = [0.9, -0.2]
SMALL = ICEM(num_candidates=40, num_elites=8, num_iterations=4, smoothing=0.2, initial_std=0.4)


def numpy_search(icem, aims, state):
    """iCEM in NumPy, on `towards`; it shares only the noise.

    Returns:
        The best sequence and the mean of every environment, and all candidates per iteration.
    """
    mean, std = np.float64(state.guess), np.full(state.guess.shape, icem.initial_std)
    kept, history = np.float64(state.elites), []
    for iteration, size in enumerate(icem.populations):
        draw_key, _ = jax.random.split(jax.random.split(KEY, icem.num_iterations)[iteration])
        shape = (len(mean), size + icem.num_kept, *mean.shape[1:])
        noise = np.float64(colored_noise(draw_key, shape, icem.noise_beta))
        candidates = np.clip(mean[:, None] + std[:, None] * noise, -1, 1)
        again = candidates[:, size:]
        candidates[:, size:] = np.where(np.isinf(kept), again, kept)
        if iteration == icem.num_iterations - 1:
            candidates = np.concatenate([candidates, mean[:, None]], axis=1)
        history.append(candidates)
        returns = -((candidates - np.reshape(aims, (-1, 1, 1, 1))) ** 2).sum((-1, -2))
        order = np.argsort(-returns, axis=1)[:, : icem.num_elites]
        elites = np.take_along_axis(candidates, order[:, :, None, None], axis=1)
        mean = icem.smoothing * mean + (1 - icem.smoothing) * elites.mean(1)
        std = icem.smoothing * std + (1 - icem.smoothing) * elites.std(1)
        kept = elites[:, : icem.num_kept]
    return elites[:, 0], mean, history


@pytest.mark.parametrize("beta", [0.0, 2.0])
def test_a_search_equals_its_numpy_twin(beta):
    icem = dataclasses.replace(SMALL, noise_beta=beta)
    earlier, _ = watch(icem, towards(AIMS), begin(icem, start(0.1)), jax.random.key(7))
    state = icem.shift(earlier.state)
    plan, seen = watch(icem, towards(AIMS), state)
    best, mean, history = numpy_search(icem, AIMS, state)
    np.testing.assert_allclose(plan.actions, best, atol=1e-5)
    np.testing.assert_allclose(plan.state.guess, mean, atol=1e-5)
    for got, want in zip(seen, history, strict=True):
        np.testing.assert_allclose(got, want, atol=1e-5)


def test_each_iteration_draws_fewer_but_never_less_than_twice_the_elites():
    icem = ICEM(num_candidates=100, num_elites=20, num_iterations=6, population_decay=1.5)
    assert icem.populations == (100, 66, 44, 40, 40, 40)
    plan, seen = watch(icem, towards(AIMS), begin(icem, start()))
    kept, final_mean = 6, 1
    sizes = [size + kept for size in icem.populations]
    sizes[-1] += final_mean
    assert [candidates.shape[1] for candidates in seen] == sizes
    np.testing.assert_array_equal(plan.evaluations, sum(sizes))


def best_of(candidates, aims, count):
    returns = -((candidates - np.reshape(aims, (-1, 1, 1, 1))) ** 2).sum((-1, -2))
    order = np.argsort(-returns, axis=1)[:, :count]
    return np.take_along_axis(candidates, order[:, :, None, None], axis=1)


def assert_drawn(actions):
    """Each action has a draw of its own, some of them clipped to the bounds."""
    inside = actions[np.abs(actions) < 1]
    assert np.isfinite(actions).all()
    assert len(np.unique(inside)) == inside.size > actions.size / 2


def test_the_best_elites_compete_again_in_the_next_iteration_and_at_the_next_step():
    plan, seen = watch(SMALL, towards(AIMS), begin(SMALL, start()))
    count = SMALL.num_kept
    assert count == 2
    for before, after, size in zip(seen, seen[1:], SMALL.populations[1:], strict=False):
        np.testing.assert_array_equal(after[:, size : size + count], best_of(before, AIMS, count))
    ended = best_of(seen[-1], AIMS, count)
    np.testing.assert_array_equal(plan.state.elites, ended)
    _, later = watch(SMALL, towards(AIMS), SMALL.shift(plan.state), jax.random.key(1))
    again = later[0][:, SMALL.populations[0] :]
    np.testing.assert_array_equal(again[..., :-1, :], ended[..., 1:, :])
    assert_drawn(again[..., -1, :])


def test_a_first_search_has_draws_where_there_are_no_elites_yet():
    _, seen = watch(SMALL, towards(AIMS), begin(SMALL, start()))
    assert_drawn(seen[0][:, SMALL.populations[0] :])
    _, bare = watch(SMALL, towards(AIMS), SearchState(start()))
    np.testing.assert_array_equal(bare[0], seen[0])


def test_elites_without_a_finite_return_are_not_kept():
    def only_one(candidates, key):
        returns = jnp.where(jnp.arange(candidates.shape[1]) == 3, 1.0, jnp.nan)
        return jnp.broadcast_to(returns, candidates.shape[:2])

    plan, seen = watch(SMALL, only_one, begin(SMALL, start()))
    np.testing.assert_array_equal(plan.actions, seen[-1][:, 3])
    np.testing.assert_array_equal(plan.state.elites[:, 0], seen[-1][:, 3])
    assert np.isinf(plan.state.elites[:, 1]).all()


def test_an_iteration_without_finite_returns_changes_nothing_but_the_count():
    failing = iter([False, True, False, True])

    def score(candidates, key):
        bad = next(failing)  # traced once per iteration
        return jnp.where(bad, jnp.nan, towards(AIMS)(candidates, key))

    plan, seen = watch(SMALL, score, begin(SMALL, start()))
    np.testing.assert_array_equal(plan.failures, 2)
    np.testing.assert_array_equal(plan.actions, best_of(seen[2], AIMS, 1)[:, 0])
    np.testing.assert_array_equal(plan.state.elites, best_of(seen[2], AIMS, SMALL.num_kept))


def test_between_two_equal_peaks_the_plan_is_at_one_and_the_mean_between():
    def two_peaks(candidates, key):
        return -jnp.square(jnp.abs(candidates) - 0.7).sum((-1, -2))

    icem = ICEM(num_candidates=400, num_elites=40, num_iterations=1, noise_beta=0.0)
    state = icem.init(NUM_ENVS, 1, 1)
    plan, _ = watch(icem, two_peaks, state)
    np.testing.assert_allclose(np.abs(plan.actions), 0.7, atol=0.05)
    np.testing.assert_allclose(plan.state.guess, 0.0, atol=0.25)


def test_the_shifted_mean_repeats_its_last_action():
    guess = jnp.arange(float(start().size)).reshape(start().shape)
    later = SMALL.shift(SMALL.init(NUM_ENVS, HORIZON, ACTIONS)._replace(guess=guess))
    np.testing.assert_array_equal(later.guess[:, :-1], guess[:, 1:])
    np.testing.assert_array_equal(later.guess[:, -1], guess[:, -1])


def test_nothing_is_kept_where_the_fraction_is_zero():
    forgetful = dataclasses.replace(SMALL, kept_elite_fraction=0.0)
    plan, seen = watch(forgetful, towards(AIMS), begin(forgetful, start()))
    assert [candidates.shape[1] for candidates in seen] == [40, 32, 25, 21]
    assert plan.state.elites.shape[1] == 0
