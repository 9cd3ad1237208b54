"""Checks every shape annotation of the core in all tests, and sets up Hypothesis and XLA."""

import os

# Most of the time goes to compiling small programs that run once: LLVM need not optimise them.
os.environ.setdefault("XLA_FLAGS", "--xla_backend_optimization_level=0")

import jaxtyping

jaxtyping.install_import_hook(
    ["headway.models", "headway.planning", "headway.data", "headway.task", "headway.envs.classic"],
    "beartype.beartype",
)

import jax  # noqa: E402
import pytest  # noqa: E402
from hypothesis import HealthCheck, settings  # noqa: E402

from headway.experiment.limits import resident  # noqa: E402
from headway.models.compilation import prepare_jax  # noqa: E402

settings.register_profile(
    "headway",
    deadline=None,
    derandomize=True,
    max_examples=15,
    suppress_health_check=[HealthCheck.too_slow],
)
settings.load_profile("headway")

prepare_jax()
MUCH = 3 * 2**30  # bytes


@pytest.fixture(autouse=True, scope="module")
def forget_compiled_programs():
    """Keep a worker below a few GiB: JAX holds on to every program that it compiled."""
    yield
    if resident() > MUCH:
        jax.clear_caches()
