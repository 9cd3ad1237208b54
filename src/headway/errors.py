"""The errors Headway raises: each says what, got, allowed, and what to do."""

import difflib
import reprlib
from collections.abc import Collection, Iterable
from importlib.util import find_spec
from typing import Any

_SHORT = reprlib.Repr()
_SHORT.maxstring = _SHORT.maxother = _SHORT.maxlong = 80


class HeadwayError(Exception):
    """Base of every error that Headway raises on purpose; its text is one line."""


class ConfigError(HeadwayError, ValueError):
    """A setting is unknown, of the wrong type, or out of range."""


class UnknownNameError(ConfigError, KeyError):
    """A name (environment, method, preset, group, ...) is not in its table."""

    def __str__(self) -> str:
        return str(self.args[0])


class BadEnvironmentError(HeadwayError, RuntimeError):
    """An environment broke its contract: wrong shape, non-finite values."""


class BrokenEpisodeError(BadEnvironmentError):
    """An episode cannot go on, though the environment can begin another one.

    An environment of your own may raise it: training then drops the episode.
    """


class RunError(HeadwayError, RuntimeError):
    """A run directory is missing, damaged, or belongs to another configuration."""


class BusyError(RunError):
    """Another process holds the run directory."""


class DivergenceError(HeadwayError, ArithmeticError):
    """Fitting produced non-finite numbers that could not be repaired."""


class PlanningError(HeadwayError, RuntimeError):
    """A controller cannot say what to do next, and has no earlier plan left to go on with."""


class LimitError(HeadwayError, RuntimeError):
    """The machine lacks the disk that a run needs."""


def one_line(text: object, longest: int | None = None) -> str:
    """A text, such as that of an error, in one line, cut after so many letters."""
    return " ".join(str(text).split())[:longest]


def shown(value: Any) -> str:
    """A value as it stands in a message: like `repr`, but never long, and in one line."""
    try:
        return _SHORT.repr(value).replace("\n", " ")
    except ValueError:  # Python refuses to write out whole numbers of thousands of digits
        return "a number of thousands of digits"


def did_you_mean(got: str, allowed: Iterable[str]) -> str:
    """Suggest the closest allowed name, in words that follow a sentence; nothing if none is."""
    close = difflib.get_close_matches(got[:80], list(allowed), n=1, cutoff=0.5)
    return f" Did you mean {close[0]!r}?" if close else ""


def unknown_name(kind: str, got: str, allowed: Iterable[str]) -> UnknownNameError:
    """Build the error for a name that is not in its table.

    Args:
        kind: What is named, for example `"environment"`.
        got: The name that was given.
        allowed: Every name that would have been accepted.

    Returns:
        An error whose text suggests the closest allowed name.
    """
    names = sorted(allowed)
    if not names:
        return UnknownNameError(f"unknown {kind} {shown(got)}. There is none; leave it out.")
    hint = did_you_mean(got, names)
    return UnknownNameError(f"unknown {kind} {shown(got)}.{hint} Allowed: {', '.join(names[:99])}.")


def check_names(kind: str, names: Iterable[str], allowed: Collection[str]) -> None:
    """Make sure that names are in their table; arguments as `unknown_name`.

    Raises:
        UnknownNameError: One is not.
    """
    for name in names:
        if name not in allowed:
            raise unknown_name(kind, str(name), allowed)


def needs(extra: str, *packages: str) -> None:
    """Make sure that the packages of an extra are installed, before anything is begun.

    Raises:
        ConfigError: One is not.
    """
    if missing := [name for name in packages if not find_spec(name)]:
        raise ConfigError(f"{', '.join(missing)} not installed; pip install 'headway[{extra}]'.")
