"""How fast this machine multiplies matrices: what times are compared with."""

import dataclasses
import time

import jax
import jax.numpy as jnp
import numpy as np

# (rows, inner, columns): what the planner multiplies, and what libraries are fastest at.
SHAPES = ((4000, 200, 200), (40_000, 200, 200), (2048, 2048, 2048), (4096, 4096, 4096))
ACCELERATOR_SIZE = 8192


@dataclasses.dataclass(frozen=True)
class Rate:
    """A rate of matrix products, measured in this run."""

    flops: float
    """Floating-point operations per second, multiply and add being two."""
    name: str

    def ratio(self, flop: float, seconds: float) -> dict[str, float | str]:
        """Columns `ratio` and `ratio_to`: `seconds` over the time of `flop` at this rate."""
        at = f"{flop / 1e9:,.1f} GFLOP at {self.flops / 1e9:,.0f} GFLOP/s ({self.name})"
        return {"ratio": seconds * self.flops / flop, "ratio_to": at}


def reference_rate() -> Rate:
    """NumPy's float32 products on a CPU, JAX's bfloat16 products elsewhere."""
    if jax.default_backend() == "cpu":
        return Rate(_numpy_flops(), "NumPy float32")
    return Rate(_accelerator_flops(), "JAX bfloat16")


def _numpy_flops() -> float:
    """The best rate over a few shapes."""
    rng = np.random.default_rng(0)
    best = 0.0
    for n, k, m in SHAPES:
        left = rng.standard_normal((n, k), np.float32)
        right = rng.standard_normal((k, m), np.float32)
        out = left @ right
        repeats = max(1, round(2e10 / (2 * n * k * m)))
        for _ in range(5):
            start = time.perf_counter()
            for _ in range(repeats):
                np.matmul(left, right, out=out)
            best = max(best, repeats * 2 * n * k * m / (time.perf_counter() - start))
    return best


def _accelerator_flops(size: int = ACCELERATOR_SIZE, repeats: int = 20) -> float:
    """The best rate of a large square product."""
    left, right = (
        jax.random.normal(jax.random.key(seed), (size, size), jnp.bfloat16) for seed in (0, 1)
    )
    product = jax.jit(jnp.matmul)
    product(left, right).block_until_ready()
    best = 0.0
    for _ in range(5):
        start = time.perf_counter()
        for _ in range(repeats):
            out = product(left, right)
        out.block_until_ready()
        best = max(best, repeats * 2 * size**3 / (time.perf_counter() - start))
    return best
