"""JAX's settings: none on import, the persistent cache when asked, none that changes numbers."""

import os
import subprocess
import sys

import jax
import pytest

from headway.cli import main
from headway.models import compilation
from headway.models.compilation import prepare_jax

IMPORTS = """
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
jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)
print(jit_networks(lambda x: jnp.tanh(x) @ x)(jnp.eye(3)).sum())
"""
FOLDER, SECONDS = "jax_compilation_cache_dir", "jax_persistent_cache_min_compile_time_secs"


def run(program, **variables):
    env = {k: v for k, v in os.environ.items() if not k.startswith(("JAX_", "XDG_CACHE"))}
    asked = [sys.executable, "-c", program]
    done = subprocess.run(asked, check=False, env=env | variables, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    return done.stdout.strip()


@pytest.fixture
def jax_settings():
    """JAX's settings, to be changed until the test ends."""
    names = (FOLDER, SECONDS, "jax_enable_compilation_cache", *compilation._NEEDED)
    before = {name: getattr(jax.config, name) for name in names}
    yield jax.config
    for name, value in before.items():
        jax.config.update(name, value)


def test_importing_changes_no_setting_of_jax():
    assert run(IMPORTS) == "[]"


@pytest.mark.skipif(sys.platform != "linux", reason="XDG folders")
def test_compiled_functions_are_kept_in_the_users_cache_folder(tmp_path):
    kept = []
    for _ in range(2):
        run(PROGRAM, XDG_CACHE_HOME=str(tmp_path))
        kept.append(sorted(path.name for path in tmp_path.rglob("*-cache")))
    assert any("lambda" in name for name in kept[0])
    assert kept[1] == kept[0]


@pytest.mark.parametrize(("chosen", "seconds"), [(None, 0.05), ("1.0", 1.0)])
def test_a_cache_is_kept_as_the_user_says(chosen, seconds, tmp_path, jax_settings, monkeypatch):
    if chosen:
        monkeypatch.setenv(SECONDS.upper(), chosen)
    jax_settings.update(SECONDS, 1.0)
    jax_settings.update(FOLDER, str(tmp_path / "mine"))
    prepare_jax()
    prepare_jax()
    assert getattr(jax_settings, SECONDS) == seconds
    assert getattr(jax_settings, FOLDER) == str(tmp_path / "mine")


def test_no_cache_is_made_where_it_is_turned_off(jax_settings):
    jax_settings.update("jax_enable_compilation_cache", False)
    jax_settings.update(FOLDER, None)
    prepare_jax()
    assert getattr(jax_settings, FOLDER) is None


def test_a_cache_that_cannot_be_written_is_one_warning(tmp_path, jax_settings, recwarn):
    (tmp_path / "file").touch()
    jax_settings.update(FOLDER, str(tmp_path / "file" / "cache"))  # root may write in any folder
    prepare_jax()
    prepare_jax()
    (warning,) = recwarn
    assert f"cannot be kept in {tmp_path}/file/cache" in str(warning.message)


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("jax_enable_x64", True),
        ("jax_numpy_rank_promotion", "raise"),
        ("jax_numpy_dtype_promotion", "strict"),
        ("jax_default_prng_impl", "rbg"),
        ("jax_threefry_partitionable", False),
    ],
)
def test_what_changes_numbers_is_refused_in_one_line_before_anything_is_collected(
    name, value, tmp_path, jax_settings, monkeypatch, capsys
):
    monkeypatch.chdir(tmp_path)
    jax_settings.update(name, value)
    assert main(["train", "pendulum", "--preset", "smoke", "--quiet"]) == 1
    said = capsys.readouterr().err
    assert said.startswith(f"error: JAX has {name} ")
    assert said.count("\n") == 1
    assert not list(tmp_path.iterdir())


def test_an_option_that_this_xla_does_not_know_is_left_out(monkeypatch):
    wanted = {"float32": ({"xla_no_such_option": 1}, {"xla_cpu_prefer_vector_width": 512})}
    monkeypatch.setattr(compilation, "_WANTED", wanted)
    found = compilation.compiler_options.__wrapped__("float32")
    known = {"xla_cpu_prefer_vector_width": 512} if jax.default_backend() == "cpu" else {}
    assert found == known
