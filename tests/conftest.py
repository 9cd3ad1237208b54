"""Checks every shape annotation of the core in all tests, and sets up Hypothesis."""

import jaxtyping

jaxtyping.install_import_hook(
    ["headway.models", "headway.planning", "headway.data", "headway.tasks"], "beartype.beartype"
)

from hypothesis import HealthCheck, settings  # noqa: E402

settings.register_profile(
    "headway",
    deadline=None,
    derandomize=True,
    max_examples=15,
    suppress_health_check=[HealthCheck.too_slow],
)
settings.load_profile("headway")
