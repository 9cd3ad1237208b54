"""What every optimizer must keep to, and how well each searches a problem with a known answer."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from search_helpers import ACTIONS, HORIZON, KEY, NUM_ENVS, begin, search, start, towards, watch

from headway.config import (
    CEMConfig,
    ICEMConfig,
    MPPIConfig,
    PlannerConfig,
    RandomShootingConfig,
)
from headway.planning.optimizers import CEM, ICEM, MPPI, RandomShooting, make_optimizer

ROUNDS = 3
OPTIMIZERS = [
    CEM(num_candidates=40, num_elites=8, num_iterations=ROUNDS),
    ICEM(num_candidates=40, num_elites=8, num_iterations=ROUNDS),
    MPPI(num_candidates=40, num_iterations=ROUNDS),
    RandomShooting(num_candidates=40, num_iterations=ROUNDS),
]


@pytest.fixture(params=OPTIMIZERS, ids=lambda optimizer: type(optimizer).__name__)
def optimizer(request):
    return request.param


@eqx.filter_jit
def push_outwards(optimizer, guess, key):
    """Search for the largest action; the return is at most 1 if no candidate is beyond bounds."""

    def largest(candidates, key):
        del key
        assert candidates.shape[0] == NUM_ENVS
        assert candidates.shape[2:] == (HORIZON, ACTIONS)
        return jnp.abs(candidates).max((-1, -2))

    return optimizer.optimize(largest, begin(optimizer, guess), key=key)


@pytest.mark.parametrize("guess", [0.0, 0.97, -1.0])
def test_plans_and_candidates_stay_within_bounds_and_shape(optimizer, guess):
    plan = push_outwards(optimizer, start(guess), KEY)
    assert plan.actions.shape == (NUM_ENVS, HORIZON, ACTIONS)
    assert plan.expected_return.shape == plan.failures.shape == (NUM_ENVS,)
    assert np.abs(np.asarray(plan.actions)).max() <= 1.0
    assert (np.asarray(plan.expected_return) <= 1.0).all()
    np.testing.assert_array_equal(plan.failures, 0)


def test_search_moves_towards_each_environments_own_optimum(optimizer):
    means = np.asarray(search(optimizer, [0.6, -0.6]).actions).mean((1, 2))
    assert means[0] > 0.2
    assert means[1] < -0.2


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
def test_a_non_finite_candidate_never_wins_nor_is_an_elite(optimizer, bad):
    plan = search(optimizer, [0.9, 0.9], bad=bad, bad_if_positive=True)
    assert (np.asarray(plan.actions)[:, 0, 0] <= 0).all()
    assert np.isfinite(plan.expected_return).all()
    np.testing.assert_array_equal(plan.failures, 0)


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
def test_when_nothing_is_finite_the_guess_is_kept_and_counted_in_that_environment_only(
    optimizer, bad
):
    guess = start(0.25).at[:, 1].set(-0.5)
    healthy = search(optimizer, [0.5, 0.5], guess=guess)
    plan = search(optimizer, [0.5, 0.5], guess=guess, bad=bad, bad_envs=[0])
    np.testing.assert_array_equal(plan.actions[0], guess[0])
    np.testing.assert_array_equal(plan.failures, [ROUNDS, 0])
    np.testing.assert_array_equal(plan.actions[1], healthy.actions[1])
    assert not np.isfinite(plan.expected_return[0])
    assert plan.expected_return[1] == healthy.expected_return[1]


def test_environments_do_not_see_each_other(optimizer):
    first = search(optimizer, [0.5, -0.3])
    second = search(optimizer, [-0.9, -0.3], guess=start().at[0].set(0.4))
    np.testing.assert_array_equal(first.actions[1], second.actions[1])
    assert (first.actions[0] != second.actions[0]).any()


def test_same_key_same_plan_and_another_key_another(optimizer):
    plans = [search(optimizer, [0.5, -0.3], key=key).actions for key in (1, 1, 2)]
    np.testing.assert_array_equal(plans[0], plans[1])
    assert (plans[0] != plans[2]).any()


def test_evaluations_are_what_was_really_scored(optimizer):
    plan, seen = watch(optimizer, towards([0.3, -0.3]), begin(optimizer, start()))
    sizes = [candidates.shape[1] for candidates in seen]
    assert len(sizes) == ROUNDS
    np.testing.assert_array_equal(plan.evaluations, sum(sizes))
    assert optimizer.max_evaluations == sum(sizes)


def test_a_first_state_starts_from_zero_and_shifting_moves_the_plan_on_by_one_step(optimizer):
    first = optimizer.init(NUM_ENVS, HORIZON, ACTIONS)
    np.testing.assert_array_equal(first.guess, start())
    ended = search(optimizer, [0.6, -0.6]).state
    later = optimizer.shift(ended)
    np.testing.assert_array_equal(later.guess[:, :-1], ended.guess[:, 1:])
    repeats = isinstance(optimizer, ICEM)
    np.testing.assert_array_equal(later.guess[:, -1], ended.guess[:, -1] if repeats else 0.0)
    assert jax.tree.map(jnp.shape, later) == jax.tree.map(jnp.shape, first)


def test_environments_draw_different_candidates(optimizer):
    plan = search(optimizer, [0.5, 0.5])
    assert (plan.actions[0] != plan.actions[1]).any()


def test_settings_reach_the_optimizer():
    def made(optimizer):
        return make_optimizer(
            PlannerConfig(num_candidates=9, num_iterations=2, optimizer=optimizer)
        )

    elites = {"num_elites": 3, "smoothing": 0.3, "initial_std": 0.4}
    assert made(CEMConfig(**elites)) == CEM(9, 3, 2, 0.3, 0.4)
    memory = {"noise_beta": 1.5, "population_decay": 1.1, "kept_elite_fraction": 0.7}
    assert made(ICEMConfig(**elites, **memory)) == ICEM(9, 3, 2, 0.3, 0.4, **memory)
    mppi = MPPIConfig(initial_std=0.4, noise_beta=1.5, temperature=0.7)
    assert made(mppi) == MPPI(9, 2, 0.4, 1.5, 0.7)
    assert made(RandomShootingConfig()) == RandomShooting(9, 2)
