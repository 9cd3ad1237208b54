"""Compiler options that this XLA knows, and the persistent cache."""

import os
import subprocess
import sys

import jax
import pytest

from headway.models import compilation

PROGRAM = """
import jax, jax.numpy as jnp
from headway.models.compilation import jit_networks
jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)
print(jit_networks(lambda x: jnp.tanh(x) @ x)(jnp.eye(3)).sum())
"""


def run_program(cache_home, **variables):
    env = {**os.environ, "XDG_CACHE_HOME": str(cache_home), **variables}
    subprocess.run([sys.executable, "-c", PROGRAM], check=True, env=env, capture_output=True)
    return sorted(path.name for path in cache_home.rglob("*-cache"))


@pytest.mark.skipif(sys.platform != "linux", reason="XDG folders")
def test_compiled_functions_are_kept_in_the_users_cache_folder(tmp_path):
    first = run_program(tmp_path)
    assert any("lambda" in name for name in first)
    assert run_program(tmp_path) == first
    elsewhere = tmp_path / "mine"
    run_program(tmp_path / "unused", JAX_COMPILATION_CACHE_DIR=str(elsewhere))
    assert not (tmp_path / "unused").exists()
    assert list(elsewhere.glob("*-cache"))
    assert not run_program(tmp_path / "off", JAX_ENABLE_COMPILATION_CACHE="0")


@pytest.mark.parametrize(("chosen", "kept"), [(None, 0.05), ("1.0", 1.0), ("0.3", 0.3)])
def test_short_compilations_are_kept_too_unless_the_user_says_otherwise(chosen, kept):
    name = "jax_persistent_cache_min_compile_time_secs"
    program = f"import headway.models.compilation, jax; print(jax.config.{name})"
    env = {key: value for key, value in os.environ.items() if key != name.upper()}
    env |= {} if chosen is None else {name.upper(): chosen}
    found = subprocess.run(
        [sys.executable, "-c", program], check=True, env=env, capture_output=True
    )
    assert float(found.stdout) == kept


def test_an_option_that_this_xla_does_not_know_is_left_out(monkeypatch):
    wanted = {"float32": ({"xla_no_such_option": 1}, {"xla_cpu_prefer_vector_width": 512})}
    monkeypatch.setattr(compilation, "_WANTED", wanted)
    found = compilation.compiler_options.__wrapped__("float32")
    known = {"xla_cpu_prefer_vector_width": 512} if jax.default_backend() == "cpu" else {}
    assert found == known
