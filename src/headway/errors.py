"""The errors Headway raises: each says what, got, allowed, and what to do."""

import difflib
from collections.abc import Iterable


class HeadwayError(Exception):
    """Base of every error that Headway raises on purpose; its text is one line."""


class ConfigError(HeadwayError, ValueError):
    """A setting is unknown, of the wrong type, or out of range."""


class UnknownNameError(HeadwayError, KeyError):
    """A name (environment, method, preset, group, ...) is not in its table."""

    def __str__(self) -> str:
        return str(self.args[0])


class BadEnvironmentError(HeadwayError, RuntimeError):
    """An environment broke its contract: wrong shape, non-finite values."""


class RunError(HeadwayError, RuntimeError):
    """A run directory is missing, damaged, or belongs to another configuration."""


class DivergenceError(HeadwayError, ArithmeticError):
    """Fitting produced non-finite numbers that could not be repaired."""


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
    close = difflib.get_close_matches(got, names, n=1, cutoff=0.5)
    hint = f" Did you mean {close[0]!r}?" if close else ""
    return UnknownNameError(f"unknown {kind} {got!r}.{hint} Allowed: {', '.join(names)}.")
