"""Identity of an environment of your own: the settings and the source that decide numbers."""

import ast
import dataclasses
import functools
import hashlib
import importlib.util
import inspect
import json
import re
import sys
from collections.abc import Iterator, Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any

import equinox as eqx
import jax
import numpy as np

from headway.config import Config, flatten
from headway.errors import shown
from headway.task import BUILT_IN, env_options, env_spec, episode_length, sim_param_sets, task_of

SOURCE = "source."
STDLIB = Path(inspect.__file__).parent
SHORT = 20  # numbers of an array that are kept as they are


def identity(config: Config) -> dict[str, Any]:
    """Describe an environment of your own, for JSON; nothing for a built-in one.

    Of the source it has the modules of the EnvSpec, of the Task and of the environment, with
    their base classes and the modules that these use; what is installed is left out. Where
    Gymnasium is not loaded, as in a controller, the environment itself is not known.
    """
    if config.env in BUILT_IN:
        return {}
    task, (environment, keywords) = task_of(config), _environment(env_spec(config.env).env_id)
    owners = [*type(task).__mro__, *getattr(environment, "__mro__", [environment])]
    modules = [config.env.rpartition(":")[0], *(str(owner.__module__) for owner in owners if owner)]
    fields = {
        field.name: _described(getattr(task, field.name)) for field in dataclasses.fields(task)
    }
    found = {
        "task": {"class": _name(type(task)), **fields},
        "environment": environment and _name(environment) + (_described(keywords) * bool(keywords)),
        "sim_params": dataclasses.asdict(sim_param_sets(config)),
        "episode_length": episode_length(config),
        "options": env_options(config),
        "source": {name: _digest(file) for name, file in sorted(_sources(modules).items())},
    }
    return json.loads(json.dumps(found))


def _sources(modules: list[str]) -> dict[str, Path]:
    """The files of modules and of all that these import, as far as they are the user's own."""
    found: dict[str, Path] = {}
    for module in modules:  # which grows
        file = _file(module)
        if module in found or file is None:
            continue
        found[module] = file
        # A script also imports what it trains with.
        if module != "__main__" and file.suffix == ".py":
            package = getattr(sys.modules.get(module), "__package__", None)
            with suppress(SyntaxError):  # it was edited since it was imported
                modules += [name for name in _imported(file, package or "") if name in sys.modules]
    return found


def _imported(file: Path, package: str) -> Iterator[str]:
    """Names that a file imports, be they of modules or of what these hold."""
    for node in ast.walk(ast.parse(file.read_bytes())):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            name = "." * node.level + (node.module or "")
            base = importlib.util.resolve_name(name, package)
            yield from (base, *(f"{base}.{alias.name}" for alias in node.names))


def changes(before: Mapping[str, Any], config: Config) -> list[str]:
    """Return one line per difference of an environment to what `identity` said of it.

    What cannot be known here, such as a module that is not there, is not compared.
    """
    old, new = flatten(before), flatten(identity(config) if before else {})
    lines = []
    for name in sorted({*old, *new}):
        was, now, module = old.get(name), new.get(name), name.removeprefix(SOURCE)
        if module == name and was != now and (name != "environment" or (was and now)):
            lines.append(f"{name}: {shown(was)} -> {shown(now)}")
        elif module != name and (file := _file(module)) and was not in (None, _digest(file)):
            lines.append(f"source of {module} changed: {file.name}")
    return lines


def _environment(entry: Any) -> tuple[Any, dict[Any, Any]]:
    """The class or function that makes an environment, or None, and what it is always given."""
    keywords: dict[Any, Any] = {}
    if isinstance(entry, str):
        env_id, entry = entry, None
        with suppress(Exception):  # no environment was made yet, or it is registered nowhere
            found = sys.modules["headway.envs.built_in"].registered(env_id)
            entry, keywords = found.entry_point, found.kwargs
    if isinstance(entry, str):
        module, _, name = entry.partition(":")
        entry = getattr(sys.modules.get(module), name, None)
    if isinstance(entry, functools.partial):
        entry, keywords = entry.func, dict(enumerate(entry.args)) | entry.keywords
    return entry if hasattr(entry, "__qualname__") else None, keywords


def _name(owner: Any) -> str:
    return f"{owner.__module__}.{owner.__qualname__}"


def _described(value: Any) -> str:
    """A value in words: a long array by its digest, an object without its address."""

    def shortened(leaf: Any) -> Any:
        if not isinstance(leaf, np.ndarray | jax.Array) or leaf.size <= SHORT:
            return leaf
        content = np.asarray(leaf).tobytes()
        return f"{leaf.dtype}{list(leaf.shape)} {hashlib.sha256(content).hexdigest()}"

    text = eqx.tree_pformat(jax.tree.map(shortened, value), short_arrays=False)
    return re.sub(" at 0x[0-9a-f]+", "", text)


def _file(module: str) -> Path | None:
    """The file of a module of the user's own; None where it is installed or has none."""
    found = getattr(sys.modules.get(module), "__file__", None)
    if module not in sys.modules:
        with suppress(Exception):  # whatever its package does while it is imported
            found = getattr(importlib.util.find_spec(module), "origin", None)
    path = Path(found or "")
    installed = {"site-packages", "dist-packages"} & {*path.parts} or path.is_relative_to(STDLIB)
    own = not installed and module.partition(".")[0] != "headway"
    return path if own and path.is_file() else None


def _digest(file: Path) -> str:
    return hashlib.sha256(file.read_bytes()).hexdigest()
