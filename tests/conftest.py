"""Checks every shape annotation of the core in all tests, and sets up Hypothesis and XLA."""

import os

import jaxlib

# Most of the time goes to compiling small programs that run once: LLVM need not optimise them.
# What newer versions of jaxlib do not know stops them.
os.environ.setdefault(
    "XLA_FLAGS",
    "--xla_backend_optimization_level=0 --xla_llvm_disable_expensive_passes=true"
    + " --xla_cpu_use_fusion_emitters=false" * jaxlib.__version__.startswith("0.10"),
)

import jaxtyping

jaxtyping.install_import_hook(
    [
        "headway.models",
        "headway.planning",
        "headway.data",
        "headway.task",
        "headway.worlds.classic",
    ],
    "beartype.beartype",
)

import shutil  # noqa: E402
from pathlib import Path  # noqa: E402

import jax  # noqa: E402
import pytest  # noqa: E402
from hypothesis import HealthCheck, settings  # noqa: E402

import runs  # noqa: E402
from headway.models.compilation import prepare_jax  # noqa: E402
from headway.training.train import train_run  # noqa: E402

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
STATM = Path("/proc/self/statm")
PAGE = 4096


@pytest.fixture(autouse=True, scope="module")
def forget_compiled_programs():
    """Keep a worker below a few GiB: JAX holds on to every program that it compiled."""
    yield
    if STATM.exists() and int(STATM.read_text().split()[1]) * PAGE > MUCH:
        jax.clear_caches()


class _Copying(runs.Progress):
    """Copies a run after two iterations."""

    def __init__(self, path: Path):
        self.path = path

    def iteration_done(self, metrics):
        if metrics["iteration"] == 1:
            shutil.copytree(self.path, self.path.with_name("two"))


@pytest.fixture(scope="session")
def reference(tmp_path_factory) -> Path:
    """A tiny run that was never stopped; only to be read."""
    path = tmp_path_factory.mktemp("reference") / "run"
    return train_run(runs.tiny_config(), path, _Copying(path)).path


@pytest.fixture(scope="session")
def two_iterations(reference) -> Path:
    """The same run after two of three iterations; only to be read."""
    return reference.with_name("two")


@pytest.fixture
def root(two_iterations, tmp_path) -> Path:
    """A copy of that run, to be changed."""
    return Path(shutil.copytree(two_iterations, tmp_path / "run"))


@pytest.fixture(scope="module")
def browser():
    """Headless Chromium; tests are skipped where it or Playwright is missing."""
    api = pytest.importorskip("playwright.sync_api", reason="no Playwright: pip install playwright")
    names = "chromium-headless-shell", "chromium", "google-chrome"
    chromium = next(filter(None, map(shutil.which, names)), None)
    if chromium is None:
        pytest.skip("no Chromium here: apt-get install chromium-headless-shell")
    with api.sync_playwright() as playwright:
        launched = playwright.chromium.launch(executable_path=chromium, args=["--no-sandbox"])
        yield launched
        launched.close()
