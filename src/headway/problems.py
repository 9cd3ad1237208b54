"""Checks of settings, whose findings are reported all at once."""

import difflib
from typing import Any

from headway.errors import ConfigError, shown

LARGEST = 10**9
"""No number of anything is larger; a file that says so is wrong, or means harm."""
MAX_LAYERS = 64
"""Hidden layers of a network."""


class Problems:
    """Collects what is wrong with one section, so that all of it is reported at once."""

    def __init__(self, section: Any):
        self._section = section
        self._found: list[str] = []

    def at_least(self, minimum: float, *names: str) -> None:
        """Numbers from `minimum` to `LARGEST`."""
        for name in names:
            value = getattr(self._section, name)
            if not minimum <= value:
                self._found.append(f"{name} is {shown(value)}, allowed: at least {minimum}")
            elif value > LARGEST:
                self._found.append(f"{name} is {shown(value)}, allowed: at most {LARGEST:,}")

    def between(self, low: float, high: float, *names: str) -> None:
        """Numbers within bounds, which belong to the range."""
        for name in names:
            value = getattr(self._section, name)
            if not low <= value <= high:
                self._found.append(f"{name} is {shown(value)}, allowed: {low} to {high}")

    def one_of(self, name: str, allowed: tuple[str, ...]) -> None:
        """One of some words."""
        value = getattr(self._section, name)
        if value not in allowed:
            close = difflib.get_close_matches(str(value)[:80], allowed, n=1)
            hint = f" (did you mean {close[0]!r}?)" if close else ""
            self._found.append(f"{name} is {shown(value)}{hint}, allowed: {', '.join(allowed)}")

    def sizes(self, name: str) -> None:
        """Widths of the layers of a network."""
        value = getattr(self._section, name)
        if not value or any(size < 1 for size in value):
            found = f"{name} is {shown(value)}, allowed: one or more widths of at least 1"
            self._found.append(found)
        elif len(value) > MAX_LAYERS or max(value) > LARGEST:
            found = f"{name} is {shown(value)}, allowed: {MAX_LAYERS} widths up to {LARGEST:,}"
            self._found.append(found)

    def require(self, condition: bool, text: str) -> None:
        """Anything else; `text` says what is, what is allowed."""
        if not condition:
            self._found.append(text)

    def report(self) -> None:
        """Raise what was found.

        Raises:
            ConfigError: Anything was.
        """
        if self._found:
            section = type(self._section).__name__.removesuffix("Config").lower()
            settings = f"{section} settings".lstrip()
            raise ConfigError(f"bad {settings}: {'; '.join(self._found)}.")
