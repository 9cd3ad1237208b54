"""Problems with known answers, on which the tests of all optimizers search."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

NUM_ENVS, HORIZON, ACTIONS = 2, 4, 2
KEY = jax.random.key(0)


def start(value=0.0):
    return jnp.full((NUM_ENVS, HORIZON, ACTIONS), value)


def towards(target):
    """A score that is highest where every action equals the environment's target."""

    def score(candidates, key):
        del key
        aim = jnp.asarray(target)[:, None, None, None]
        return -jnp.square(candidates - aim).sum((-1, -2))

    return score


@eqx.filter_jit
def optimize(optimizer, target, guess, bad, bad_envs, bad_if_positive, key):
    def score(candidates, key):
        spoiled = bad_envs[:, None] | (bad_if_positive & (candidates[..., 0, 0] > 0))
        return jnp.where(spoiled, bad, towards(target)(candidates, key))

    return optimizer.optimize(score, begin(optimizer, guess), key=key)


def begin(optimizer, guess):
    """The optimizer's own first state, but for the guess."""
    return optimizer.init(*guess.shape)._replace(guess=guess)


def search(optimizer, target, *, guess=None, bad=0.0, bad_envs=(), bad_if_positive=False, key=0):
    """Search for `target`; some candidates or all of some environments have a `bad` return."""
    return optimize(
        optimizer,
        jnp.asarray(target),
        start() if guess is None else guess,
        jnp.asarray(bad),
        jnp.asarray([env in bad_envs for env in range(NUM_ENVS)]),
        jnp.asarray(bad_if_positive),
        jax.random.key(key),
    )


def watch(optimizer, score, state, key=KEY):
    """Search, and keep the candidates of every iteration, in float64."""
    seen = []

    def watched(candidates, key):
        jax.debug.callback(lambda x: seen.append(np.float64(x)), candidates, ordered=True)
        return score(candidates, key)

    plan = optimizer.optimize(watched, state, key=key)
    jax.effects_barrier()
    return plan, seen


GAIN, COST, STEPS = 0.3, 0.1, 10


def linear_quadratic(x0):
    """The return of x' = x + 0.3 u under -x^2 - 0.1 u^2, and its best possible value."""

    def score(candidates, key):
        del key
        x = x0[:, None, None] + GAIN * jnp.cumsum(candidates, axis=-2)
        return -(jnp.square(x) + COST * jnp.square(candidates)).sum((-1, -2))

    lower = GAIN * np.tril(np.ones((STEPS, STEPS)))
    hessian = lower.T @ lower + COST * np.eye(STEPS)
    best = 0.0
    for x in np.asarray(x0, np.float64).T:
        u = -np.linalg.solve(hessian, lower.T @ np.tile(x, (STEPS, 1)))
        assert np.abs(u).max() < 1
        best = best - ((x + lower @ u) ** 2 + COST * u**2).sum(0)
    return score, best
