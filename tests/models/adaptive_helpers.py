"""Set-ups of the tests of GrBAL's and ReBAL's networks."""

import jax.numpy as jnp
import numpy as np

import toys
from headway.config import GradientAdaptedConfig
from headway.models.grbal import Window

TINY = GradientAdaptedConfig(hidden_sizes=(5,))


def random_window(seed, *shape):
    rng = np.random.default_rng(seed)
    x, delta = rng.normal(size=(*shape, 4)), rng.normal(size=(*shape, 2))
    weight = np.ones(shape)
    weight[..., -1] = 0.0  # padding must not count
    return Window(*(jnp.asarray(a, jnp.float32) for a in (x, delta, weight)))


def toy_data(gains, steps=40):
    trajectories = [toys.random_trajectory(steps, i, gain) for i, gain in enumerate(gains)]
    layout = {"future_length": 1, "max_length": steps + 3, "statistics": toys.identity_statistics()}
    return toys.fit_data(trajectories, toys.make_setup(), members=1, **layout), trajectories
