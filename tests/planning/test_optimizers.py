"""Optimizers: what all keep to, each against a NumPy twin, and how well they search."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from headway.config import CEMConfig, ICEMConfig, ILQRConfig, PlannerConfig, RandomShootingConfig
from headway.planning.optimizers import CEM, ICEM, RandomShooting, make_optimizer
from headway.planning.optimizers.base import colored_noise

NUM_ENVS, HORIZON, ACTIONS, ROUNDS = 2, 4, 2, 3
KEY = jax.random.key(0)
AIMS = [0.9, -0.2]
OPTIMIZERS = [
    CEM(40, ROUNDS, 8, smoothing=0.2, initial_std=0.3),
    ICEM(40, ROUNDS, 8, smoothing=0.2, initial_std=0.4),
    RandomShooting(40, ROUNDS),
]
SMALL_CEM, SMALL_ICEM, _ = OPTIMIZERS


@pytest.fixture(params=OPTIMIZERS, ids=lambda optimizer: type(optimizer).__name__)
def optimizer(request):
    return request.param


def plan_of(value=0.0):
    return jnp.full((NUM_ENVS, HORIZON, ACTIONS), value)


def begin(optimizer, nominal=0.0):
    """The optimizer's own start, but for the nominal plan."""
    nominal = plan_of(nominal) if np.isscalar(nominal) else nominal
    search = optimizer.init(*nominal.shape)
    return search._replace(nominal=nominal, best=None if search.best is None else nominal)


def towards(target):
    """A score that is highest where every action equals the environment's target."""
    aim = jnp.asarray(target)[:, None, None, None]
    return lambda candidates, key: -jnp.square(candidates - aim).sum((-1, -2))


@eqx.filter_jit
def optimize(optimizer, target, start, bad, bad_envs, bad_if_positive, key):
    def score(candidates, key):
        spoiled = bad_envs[:, None] | (bad_if_positive & (candidates[..., 0, 0] > 0))
        return jnp.where(spoiled, bad, towards(target)(candidates, key))

    return optimizer.optimize(score, start, key=key)


def search(optimizer, target, *, start=0.0, bad=0.0, bad_envs=(), bad_if_positive=False, key=0):
    """Search for `target`; some candidates or all of some environments have a `bad` return."""
    envs = jnp.asarray([env in bad_envs for env in range(NUM_ENVS)])
    args = jnp.asarray(bad), envs, jnp.asarray(bad_if_positive), jax.random.key(key)
    return optimize(optimizer, jnp.asarray(target), begin(optimizer, start), *args)


def watch(optimizer, score, start, key=KEY):
    """Search, and keep the candidates of every iteration, in float64."""
    seen = []

    def watched(candidates, key):
        jax.debug.callback(lambda x: seen.append(np.float64(x)), candidates, ordered=True)
        return score(candidates, key)

    found = optimizer.optimize(watched, start, key=key)
    jax.effects_barrier()
    return found, seen


# What all keep to.


@pytest.mark.parametrize("start", [0.0, 0.97, -1.0])
def test_plans_and_candidates_stay_within_bounds_and_shape(optimizer, start):
    def largest(candidates, key):
        return jnp.abs(candidates).max((-1, -2))

    found, seen = watch(optimizer, largest, begin(optimizer, start))
    assert found.actions.shape == (NUM_ENVS, HORIZON, ACTIONS)
    assert np.abs(found.actions).max() <= 1.0
    for candidates in seen:
        assert candidates.shape[0] == NUM_ENVS
        assert candidates.shape[2:] == (HORIZON, ACTIONS)
        assert np.abs(candidates).max() <= 1.0 + 1e-6
    np.testing.assert_array_equal(found.evaluations, sum(x.shape[1] for x in seen))


def test_a_plan_at_a_bound_leaves_it_when_what_is_best_has_changed(optimizer):
    assert search(optimizer, [-0.9, -0.9], start=1.0).actions.mean() < 0.8


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
def test_non_finite_returns_rank_last(optimizer, bad):
    found = search(optimizer, [0.9, 0.9], bad=bad, bad_if_positive=True)
    assert (np.asarray(found.actions)[:, 0, 0] <= 0).all()
    np.testing.assert_array_equal(found.non_finite, 0)


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
def test_where_nothing_is_finite_the_nominal_plan_is_kept_in_that_environment_only(optimizer, bad):
    start = plan_of(0.25).at[:, 1].set(-0.5)
    healthy = search(optimizer, [0.5, 0.5], start=start)
    found = search(optimizer, [0.5, 0.5], start=start, bad=bad, bad_envs=[0])
    np.testing.assert_array_equal(found.actions[0], start[0])
    np.testing.assert_array_equal(found.non_finite, [ROUNDS, 0])
    np.testing.assert_array_equal(found.actions[1], healthy.actions[1])


def test_an_iteration_without_finite_returns_changes_nothing_but_the_count(optimizer):
    found, (candidates, *_) = watch(optimizer, towards(AIMS), begin(optimizer))
    candidates = jnp.asarray(candidates, jnp.float32)
    after = optimizer.tell(found, candidates, jnp.full(candidates.shape[:2], jnp.nan))
    np.testing.assert_array_equal(after.actions, found.actions)
    np.testing.assert_array_equal(after.nominal, found.nominal)
    np.testing.assert_array_equal(after.elites, found.elites)
    np.testing.assert_array_equal(after.non_finite, 1)


def test_environments_draw_for_themselves_by_the_key_and_do_not_see_each_other(optimizer):
    first, again, other = (search(optimizer, [0.5, 0.5], key=key).actions for key in (1, 1, 2))
    np.testing.assert_array_equal(first, again)
    assert (first != other).any()
    assert (first[0] != first[1]).any()
    beside = search(optimizer, [-0.9, 0.5], start=plan_of().at[0].set(0.4), key=1).actions
    np.testing.assert_array_equal(first[1], beside[1])
    assert (first[0] != beside[0]).any()


def test_a_shifted_search_starts_from_the_nominal_plan_one_step_later(optimizer):
    ended, fresh = search(optimizer, [0.6, -0.6]), optimizer.init(NUM_ENVS, HORIZON, ACTIONS)
    later = optimizer.shift(ended)
    np.testing.assert_array_equal(later.nominal[:, :-1], ended.nominal[:, 1:])
    last = ended.nominal[:, -1] if isinstance(optimizer, ICEM) else 0.0  # iCEM repeats it
    np.testing.assert_array_equal(later.nominal[:, -1], last)
    np.testing.assert_array_equal(later.actions, later.nominal)
    for name in ("std", "best_return", "evaluations", "non_finite"):
        np.testing.assert_array_equal(getattr(later, name), getattr(fresh, name))


@pytest.mark.parametrize(
    "settings",
    [
        CEMConfig(num_elites=3, smoothing=0.3, initial_std=0.4),
        ICEMConfig(num_elites=3, noise_beta=1.5, population_decay=1.1, kept_elite_fraction=0.7),
        RandomShootingConfig(),
        ILQRConfig(action_cost=0.3),
    ],
    ids=str,
)
def test_settings_reach_the_optimizer(settings):
    planner = PlannerConfig(num_candidates=9, num_iterations=2, optimizer=settings)
    made, wanted = make_optimizer(planner), vars(settings) | {"name": settings.name}
    assert type(made).__name__.lower() == wanted.pop("name").replace("-", "")
    assert {name: getattr(made, name) for name in wanted} == wanted
    assert (made.num_candidates, made.num_iterations) == (9, 2)


# Each against a NumPy twin on `towards(AIMS)`; twins share only the random draws.


def ask_keys(optimizer):
    return [jax.random.split(key)[0] for key in jax.random.split(KEY, optimizer.num_iterations)]


def numpy_returns(candidates):
    return -((candidates - np.reshape(AIMS, (-1, 1, 1, 1))) ** 2).sum((-1, -2))


def best_of(candidates, count):
    order = np.argsort(-numpy_returns(candidates), axis=1)[:, :count]
    return np.take_along_axis(candidates, order[:, :, None, None], axis=1)


@pytest.mark.parametrize(
    ("start", "narrow"), [(0.0, False), (0.9, False), (-1.0, False), (0.0, True), (0.5, True)]
)
def test_cem_equals_its_numpy_twin(start, narrow):
    cem = dataclasses.replace(SMALL_CEM, narrow_at_bounds=narrow)
    mean = np.float64(plan_of(start))
    var = np.full(mean.shape, cem.initial_std**2)
    found, seen = watch(cem, towards(AIMS), begin(cem, start))
    for key, got in zip(ask_keys(cem), seen, strict=True):
        shape = (NUM_ENVS, cem.num_candidates, HORIZON, ACTIONS)
        draws = np.float64(jax.random.truncated_normal(key, -2.0, 2.0, shape))
        std, room = np.sqrt(var), 1 - np.abs(mean)
        std = np.minimum(room / 2, std) if narrow else std
        candidates = np.clip(mean[:, None] + std[:, None] * draws, -1, 1)
        np.testing.assert_allclose(got, candidates, atol=1e-5)
        elites = best_of(candidates, cem.num_elites)
        mean = cem.smoothing * mean + (1 - cem.smoothing) * elites.mean(1)
        var = cem.smoothing * var + (1 - cem.smoothing) * elites.var(1)
    np.testing.assert_allclose(found.actions, mean, atol=1e-5)


@pytest.mark.parametrize("beta", [0.0, 2.0])
def test_icem_equals_its_numpy_twin(beta):
    icem = dataclasses.replace(SMALL_ICEM, noise_beta=beta)
    earlier, _ = watch(icem, towards(AIMS), begin(icem, 0.1), jax.random.key(7))
    start = icem.shift(earlier)
    mean, std = np.float64(start.nominal), np.full(start.nominal.shape, icem.initial_std)
    found, seen = watch(icem, towards(AIMS), start)
    kept = np.float64(start.elites)
    rounds = zip(icem.populations, ask_keys(icem), seen, strict=True)
    for iteration, (size, key, got) in enumerate(rounds):
        noise = colored_noise(key, (NUM_ENVS, size + icem.num_kept, HORIZON, ACTIONS), beta)
        candidates = np.clip(mean[:, None] + std[:, None] * np.float64(noise), -1, 1)
        candidates[:, size:] = np.where(np.isinf(kept), candidates[:, size:], kept)
        if iteration == icem.num_iterations - 1:
            candidates = np.concatenate([candidates, mean[:, None]], axis=1)
        np.testing.assert_allclose(got, candidates, atol=1e-5)
        elites = best_of(candidates, icem.num_elites)
        mean = icem.smoothing * mean + (1 - icem.smoothing) * elites.mean(1)
        std = icem.smoothing * std + (1 - icem.smoothing) * elites.std(1)
        kept = elites[:, : icem.num_kept]
    np.testing.assert_allclose(found.actions, elites[:, 0], atol=1e-5)
    np.testing.assert_allclose(found.nominal, mean, atol=1e-5)


def test_random_shooting_takes_the_best_candidate_of_all_rounds():
    found, seen = watch(OPTIMIZERS[-1], towards(AIMS), begin(OPTIMIZERS[-1]))
    best = best_of(np.concatenate(seen, axis=1), 1)[:, 0]
    np.testing.assert_allclose(found.actions, best, atol=1e-6)
    np.testing.assert_allclose(found.best_return, numpy_returns(best[:, None])[:, 0], rtol=1e-4)


# What is special about each.


def only_one(candidates, key):
    returns = jnp.where(jnp.arange(candidates.shape[1]) == 3, 1.0, jnp.nan)
    return jnp.broadcast_to(returns, candidates.shape[:2])


def test_with_fewer_finite_candidates_than_elites_only_the_finite_ones_count():
    found = [CEM(40, 1, n).optimize(only_one, begin(CEM(40, 1, n)), key=KEY) for n in (1, 8)]
    np.testing.assert_allclose(found[0].actions, found[1].actions, atol=1e-7)
    icem, seen = watch(SMALL_ICEM, only_one, begin(SMALL_ICEM))
    np.testing.assert_array_equal(icem.elites[:, 0], seen[-1][:, 3])
    assert np.isinf(icem.elites[:, 1]).all()


def assert_drawn(actions):
    """Each action has a draw of its own, some of them clipped to the bounds."""
    inside = actions[np.abs(actions) < 1]
    assert len(np.unique(inside)) == inside.size > actions.size / 2


def test_the_best_elites_of_icem_compete_again_at_the_next_step():
    found, seen = watch(SMALL_ICEM, towards(AIMS), begin(SMALL_ICEM))
    assert_drawn(seen[0][:, SMALL_ICEM.populations[0] :])
    ended = best_of(seen[-1], SMALL_ICEM.num_kept)
    _, later = watch(SMALL_ICEM, towards(AIMS), SMALL_ICEM.shift(found), jax.random.key(1))
    again = later[0][:, SMALL_ICEM.populations[0] :]
    np.testing.assert_array_equal(again[..., :-1, :], ended[..., 1:, :])
    assert_drawn(again[..., -1, :])


def test_each_iteration_of_icem_draws_fewer_but_never_less_than_twice_the_elites():
    icem = ICEM(num_candidates=100, num_elites=20, num_iterations=6, population_decay=1.5)
    assert icem.populations == (100, 66, 44, 40, 40, 40)
    none_kept = dataclasses.replace(SMALL_ICEM, kept_elite_fraction=0.0)
    _, seen = watch(none_kept, towards(AIMS), begin(none_kept))
    assert [candidates.shape[1] for candidates in seen] == [40, 32, 25 + 1]  # and the last mean


def test_cem_beats_random_shooting_with_as_many_candidates_and_nears_the_optimum():
    """A linear-quadratic problem: x' = x + 0.3 u under -x² - 0.1 u²."""
    x0, gain, cost, steps = np.float32([[0.5, -0.4], [-0.3, 0.1], [0.2, 0.4]]), 0.3, 0.1, 10

    def score(candidates, key):
        x = x0[:, None, None] + gain * jnp.cumsum(candidates, axis=-2)
        return -(jnp.square(x) + cost * jnp.square(candidates)).sum((-1, -2))

    lower = gain * np.tril(np.ones((steps, steps)))
    best = -np.linalg.solve(lower.T @ lower + cost * np.eye(steps), lower.sum(0))
    best = jnp.asarray(best[:, None] * x0[:, None], jnp.float32)

    @eqx.filter_jit
    def achieved(key):
        nothing = jnp.zeros_like(best)
        found, drawn = (
            one.optimize(score, begin(one, nothing), key=key).actions
            for one in (CEM(200, 8, 20), RandomShooting(200, 8))
        )
        return score(jnp.stack([found, drawn, best, nothing], axis=1), None)

    for key in range(3):
        found, drawn, optimum, idle = np.asarray(achieved(jax.random.key(key))).T
        assert (found > drawn).all()
        assert (found <= optimum + 1e-5).all()
        assert ((optimum - found) < 0.05 * (optimum - idle)).all()


@pytest.mark.parametrize("beta", [0.0, 0.5, 2.0])
def test_coloured_noise_has_the_spectrum_and_the_size_it_promises(beta):
    noise = np.float64(colored_noise(KEY, (4000, 32, 2), beta))
    power = (np.abs(np.fft.rfft(noise, axis=1)) ** 2).mean((0, 2))
    frequency = np.arange(1, 16)  # neither the constant part nor the highest frequency
    slope, _ = np.polyfit(np.log(frequency), np.log(power[1:16]), 1)
    assert slope == pytest.approx(-beta, abs=0.05)
    for horizon in (1, 7, 32):
        noise = np.float64(colored_noise(KEY, (4000, horizon, 2), beta))
        np.testing.assert_allclose(noise.mean(0), 0.0, atol=0.07)
        np.testing.assert_allclose(noise.var(0), 1.0, atol=0.12)
    assert abs(np.corrcoef(noise[:, 5, 0], noise[:, 5, 1])[0, 1]) < 0.06
    assert abs(np.corrcoef(noise[:-1, 5, 0], noise[1:, 5, 0])[0, 1]) < 0.06
