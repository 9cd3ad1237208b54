"""JAX's settings: none on import, the persistent cache when asked, no 64-bit mode."""

import os
import subprocess
import sys

import jax
import pytest

from headway.models import compilation

SETTINGS = """
import jax, pkgutil, importlib
before = dict(jax.config.values)
import headway
for module in pkgutil.walk_packages(headway.__path__, "headway."):
    if not module.name.endswith("__main__"):
        importlib.import_module(module.name)
print([name for name, value in jax.config.values.items() if before.get(name, value) != value])
"""
PROGRAM = """
import jax, jax.numpy as jnp
from headway.models.compilation import jit_networks, prepare_jax
prepare_jax()
prepare_jax()
print(jax.config.jax_persistent_cache_min_compile_time_secs)
jax.config.update("jax_persistent_cache_min_compile_time_secs", {seconds})
print(jit_networks(lambda x: jnp.tanh(x) @ x)(jnp.eye(3)).sum())
"""
KEPT = "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS"


def run(program, **variables):
    env = {k: v for k, v in os.environ.items() if not k.startswith(("JAX_", "XDG_CACHE"))}
    asked = [sys.executable, "-c", program]
    return subprocess.run(asked, check=False, env=env | variables, capture_output=True, text=True)


def kept(cache_home, **variables):
    """Names of what a program leaves in the user's cache folder."""
    found = run(PROGRAM.format(seconds=0.0), XDG_CACHE_HOME=str(cache_home), **variables)
    assert found.returncode == 0, found.stderr
    return sorted(path.name for path in cache_home.rglob("*-cache"))


def test_importing_changes_no_setting_of_jax():
    found = run(SETTINGS)
    assert found.stdout.strip() == "[]", found.stderr


@pytest.mark.skipif(sys.platform != "linux", reason="XDG folders")
def test_compiled_functions_are_kept_in_the_users_cache_folder(tmp_path):
    first = kept(tmp_path)
    assert any("lambda" in name for name in first)
    assert kept(tmp_path) == first
    elsewhere = tmp_path / "mine"
    kept(tmp_path / "unused", JAX_COMPILATION_CACHE_DIR=str(elsewhere))
    assert not (tmp_path / "unused").exists()
    assert list(elsewhere.glob("*-cache"))
    assert not kept(tmp_path / "off", JAX_ENABLE_COMPILATION_CACHE="0")


@pytest.mark.parametrize(("chosen", "seconds"), [(None, 0.05), ("1.0", 1.0), ("0.3", 0.3)])
def test_short_compilations_are_kept_too_unless_the_user_says_otherwise(chosen, seconds, tmp_path):
    variables = {} if chosen is None else {KEPT: chosen}
    found = run(PROGRAM.format(seconds=1.0), XDG_CACHE_HOME=str(tmp_path), **variables)
    assert float(found.stdout.split()[0]) == seconds


def test_a_cache_that_cannot_be_written_is_one_warning(tmp_path):
    (tmp_path / "file").touch()
    folder = str(tmp_path / "file" / "cache")  # root may write in any folder
    found = run(PROGRAM.format(seconds="jnp.inf"), JAX_COMPILATION_CACHE_DIR=folder)
    assert found.returncode == 0, found.stderr
    assert found.stderr.count("Warning") == 1
    assert f"cannot be kept in {folder}" in found.stderr


def test_64_bit_mode_is_refused_in_one_line_before_anything_is_collected(tmp_path):
    program = "import sys; from headway.cli import main; sys.exit(main(sys.argv[1:]))"
    asked = [sys.executable, "-c", program, "train", "pendulum", "--preset", "smoke", "--quiet"]
    env = {**os.environ, "JAX_ENABLE_X64": "1"}
    found = subprocess.run(
        asked, check=False, env=env, cwd=tmp_path, capture_output=True, text=True
    )
    assert found.returncode == 1
    assert found.stderr.startswith("error: JAX is in 64-bit mode, allowed: 32-bit mode")
    assert found.stderr.count("\n") == 1
    assert not list(tmp_path.iterdir())


def test_an_option_that_this_xla_does_not_know_is_left_out(monkeypatch):
    wanted = {"float32": ({"xla_no_such_option": 1}, {"xla_cpu_prefer_vector_width": 512})}
    monkeypatch.setattr(compilation, "_WANTED", wanted)
    found = compilation.compiler_options.__wrapped__("float32")
    known = {"xla_cpu_prefer_vector_width": 512} if jax.default_backend() == "cpu" else {}
    assert found == known
