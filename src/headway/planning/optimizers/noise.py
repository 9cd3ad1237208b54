"""Noise whose neighbouring steps resemble each other (Timmer and König, 1995)."""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PRNGKeyArray


def colored_noise(
    key: PRNGKeyArray, shape: tuple[int, ...], beta: float
) -> Float[Array, "*batch horizon action"]:
    """Draw normal noise of unit variance whose power falls with frequency as f^-beta.

    Each action has a noise of its own; the spectrum is that along the horizon.

    Args:
        key: Draws the noise.
        shape: Any number of axes, then horizon and action.
        beta: 0 gives white noise, 1 pink, 2 red; larger is smoother.
    """
    white = jax.random.normal(key, shape)
    if beta == 0:
        return white
    return jnp.einsum("ts,...sa->...ta", shaping(shape[-2], beta), white)


def shaping(horizon: int, beta: float) -> Float[np.ndarray, "horizon horizon"]:
    """The matrix that turns white noise into coloured noise; every row has norm 1.

    It scales each frequency by f^(-beta/2). The constant part, which would be infinite, counts
    as one period in the horizon.
    """
    cycles = np.maximum(np.arange(horizon // 2 + 1), 1)  # per horizon
    amplitude = cycles ** (-beta / 2)
    filtered = np.fft.irfft(amplitude[:, None] * np.fft.rfft(np.eye(horizon), axis=0), horizon, 0)
    return (filtered / np.linalg.norm(filtered[0])).astype(np.float32)
