"""Settings in and out: plain dictionaries, dotted names, differences."""

import dataclasses
import difflib
import typing
from collections.abc import Mapping
from typing import Any, Literal

from headway.config import Config
from headway.config.unused import unused_settings
from headway.errors import ConfigError, shown
from headway.sim_params import SimParamSets

TOLERANCE = (
    "collection.max_bad_episodes",
    "collection.env_processes",
    "collection.step_timeout_s",
    "evaluation.max_bad_episodes",
)
"""What is done about environments that break; the numbers of sound episodes do not depend on it,
so a run may go on with other values."""


def to_dict(config: Config) -> dict[str, Any]:
    """Return the settings as nested dictionaries of plain values."""
    values = dataclasses.asdict(dataclasses.replace(config, sim_params=None))
    values["env_options"] = dict(config.env_options)
    values["sim_params"] = config.sim_params.to_dict() if config.sim_params else None
    return values


def from_dict(values: Mapping[str, Any]) -> Config:
    """Rebuild the settings that `to_dict` wrote.

    Raises:
        ConfigError: A setting is unknown, of the wrong type or out of range.
    """
    return _build(Config, values, prefix="")


def override(config: Config, settings: Mapping[str, Any]) -> Config:
    """Return `config` with some settings replaced.

    Args:
        config: The settings to start from.
        settings: New values by dotted name, for example `{"planner.horizon": 20}`.

    Raises:
        ConfigError: A setting is unknown, of the wrong type or out of range.
    """
    values = to_dict(config)
    known = setting_names(config)
    for name, value in settings.items():
        if name not in known:
            raise ConfigError(unknown_setting(name, known))
        section, _, field = name.rpartition(".")
        (values[section] if section else values)[field] = value
    if isinstance(values["sim_params"], SimParamSets):
        values["sim_params"] = values["sim_params"].to_dict()
    return from_dict(values)


def setting_names(config: Config) -> list[str]:
    """Return every setting's dotted name."""
    names = []
    for field in dataclasses.fields(config):
        value = getattr(config, field.name)
        if dataclasses.is_dataclass(value) and not isinstance(value, SimParamSets):
            names += [f"{field.name}.{inner.name}" for inner in dataclasses.fields(value)]
        else:
            names.append(field.name)
    return names


def relevant(config: Config, usual: Config | None = None) -> dict[str, Any]:
    """Every setting by dotted name, those that the run cannot use as they usually are.

    Two configurations whose relevant settings are equal make the same run.

    Args:
        config: The settings of the run.
        usual: Gives the values of what the run cannot use; the defaults do, if it is None.
    """
    flat = flatten(to_dict(config))
    instead = flatten(to_dict(usual or Config(env=config.env)))
    return flat | {name: instead[name] for name in unused_settings(config)}


def differences(old: Config, new: Config) -> list[str]:
    """Return one line per setting that differs, for people to read; none where runs are the same.

    What a run cannot use does not count (`relevant`).
    """
    before, after = relevant(old), relevant(new)
    return [
        f"{name}: {shown(before.get(name))} -> {shown(after.get(name))}"
        for name in sorted({*before, *after})
        if before.get(name) != after.get(name)
    ]


def tolerating_as(config: Config, other: Config) -> Config:
    """Return `config` with the `TOLERANCE` of another one."""
    values = flatten(to_dict(other))
    return override(config, {name: values[name] for name in TOLERANCE})


def unknown_setting(name: str, known: list[str]) -> str:
    """Word the error for an unknown setting, with the closest known one."""
    name = name[:80]
    close = difflib.get_close_matches(name, known, n=1, cutoff=0.4)
    if not close:
        tails = {full.rpartition(".")[2]: full for full in known}
        close = [tails[tail] for tail in difflib.get_close_matches(name, tails, n=1)]
    hint = f" Did you mean {close[0]!r}?" if close else ""
    return f"unknown setting {name!r}.{hint} `headway train ENV --help` lists all settings."


def flatten(values: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    """The values of nested tables by dotted name."""
    flat = {}
    for name, value in values.items():
        if isinstance(value, Mapping) and value:
            flat |= flatten(value, f"{prefix}{name}.")
        else:
            flat[prefix + name] = list(value) if isinstance(value, tuple) else value
    return flat


def _build(cls: type, values: Any, prefix: str) -> Any:
    if not isinstance(values, Mapping):
        section = prefix.removesuffix(".") or "config"
        raise ConfigError(f"{section} is {shown(values)}, allowed: a table of settings.")
    hints = typing.get_type_hints(cls)
    fields = [field.name for field in dataclasses.fields(cls)]
    for name in values:
        if name not in fields:
            raise ConfigError(unknown_setting(f"{prefix}{name}", [prefix + f for f in fields]))
    missing = [
        field.name
        for field in dataclasses.fields(cls)
        if field.name not in values
        and field.default is dataclasses.MISSING
        and field.default_factory is dataclasses.MISSING
    ]
    if missing:
        raise ConfigError(f"the settings lack {', '.join(prefix + name for name in missing)}.")
    converted, problems = {}, []
    for name, value in values.items():
        try:
            converted[name] = _convert(hints[name], value, f"{prefix}{name}")
        except ConfigError as problem:
            problems.append(str(problem))
    if problems:
        raise ConfigError(" ".join(problems))
    return cls(**converted)


def _convert(hint: Any, value: Any, name: str) -> Any:
    """Check one value against its field's type; lists become tuples, ints become floats."""
    origin = typing.get_origin(hint)
    if hint == SimParamSets | None:
        return (
            value
            if value is None or isinstance(value, SimParamSets)
            else (SimParamSets.from_dict(value))
        )
    if isinstance(hint, type) and dataclasses.is_dataclass(hint):
        return value if isinstance(value, hint) else _build(hint, value, f"{name}.")
    if origin is tuple and isinstance(value, list | tuple):
        return tuple(_convert(int, item, name) for item in value)
    if origin is Literal and isinstance(value, str):
        return value
    if origin is Mapping:
        if isinstance(value, Mapping) and all(isinstance(v, bool) for v in value.values()):
            return dict(value)
    elif hint is float and isinstance(value, int | float) and not isinstance(value, bool):
        try:
            return float(value)
        except OverflowError:
            pass
    elif isinstance(hint, type) and type(value) is hint:
        return value
    wanted = getattr(hint, "__name__", str(hint)) if origin is None else str(hint)
    raise ConfigError(f"{name} is {shown(value)}, allowed: {wanted.replace('typing.', '')}.")
