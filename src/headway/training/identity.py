"""Identity of an environment of your own: the settings and the source that decide numbers."""

import ast
import dataclasses
import hashlib
import importlib.util
import inspect
import json
import sys
from collections.abc import Iterator, Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any

import equinox as eqx

from headway.config import Config, flatten
from headway.errors import shown
from headway.task import BUILT_IN, env_options, env_spec, episode_length, sim_param_sets, task_of

SOURCE = "source."
STDLIB = Path(inspect.__file__).parent


def identity(config: Config) -> dict[str, Any]:
    """Describe an environment of your own, for JSON; nothing for a built-in one.

    Of the source it has the modules of the EnvSpec, of the Task and of the environment, with
    their base classes and the modules that these use; what is installed is left out. Where
    Gymnasium is not loaded, as in a controller, the environment itself is not known.
    """
    if config.env in BUILT_IN:
        return {}
    task, environment = task_of(config), _environment(env_spec(config.env).env_id)
    owners = [*type(task).__mro__, *getattr(environment, "__mro__", [environment])]
    modules = [config.env.partition(":")[0], *(str(owner.__module__) for owner in owners if owner)]
    fields = {
        field.name: eqx.tree_pformat(getattr(task, field.name), short_arrays=False)
        for field in dataclasses.fields(task)
    }
    found = {
        "task": {"class": f"{type(task).__module__}.{type(task).__qualname__}", **fields},
        "environment": environment and f"{environment.__module__}.{environment.__qualname__}",
        "sim_params": sim_param_sets(config).to_dict(),
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
        if (
            module != "__main__" and file.suffix == ".py"
        ):  # a script also imports what it trains with
            package = getattr(sys.modules.get(module), "__package__", None)
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


def _environment(env_id: Any) -> Any:
    """The class or function that makes an environment; None where it is not known."""
    gymnasium = sys.modules.get("gymnasium")
    found = gymnasium and gymnasium.registry.get(str(env_id).rpartition(":")[2])
    entry = found.entry_point if found else env_id
    if isinstance(entry, str):
        module, _, name = entry.partition(":")
        entry = getattr(sys.modules.get(module), name, None)
    entry = getattr(entry, "func", entry)  # of a functools.partial
    return entry if hasattr(entry, "__qualname__") else None


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
