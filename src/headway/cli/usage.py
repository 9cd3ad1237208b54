"""Wrong usage, told in one line."""

import contextlib
import dataclasses
import difflib
import io
import itertools
import re
import typing
from collections.abc import Iterable, Sequence
from typing import Any, TypeVar

Arguments = TypeVar("Arguments")

_RULE = "-" * 10
_ALLOWED = {
    "INT": "a whole number",
    "FLOAT": "a number",
    "[INT [INT ...]]": "whole numbers, separated by spaces",
}


class UsageError(Exception):
    """The command line is not one that a command understands."""


def one_line(text: str) -> str:
    """Join lines."""
    return " ".join(text.split())


def closest(name: str, known: Iterable[str]) -> str:
    """Word a suggestion, or nothing when no known name is close."""
    found = difflib.get_close_matches(name, list(known), n=1, cutoff=0.5)
    return f" Did you mean {found[0]!r}?" if found else ""


def parse(arguments: type[Arguments], default: Any, words: Sequence[str], prog: str) -> Arguments:
    """Parse a command's words.

    Args:
        arguments: The dataclass that describes the command.
        default: An instance that holds the defaults.
        words: What was typed after the command's name.
        prog: The command's name, for messages.

    Raises:
        UsageError: An option is unknown, an argument is missing or of the wrong type.
        SystemExit: Help was asked for and printed; the code is 0.
    """
    import tyro

    _check_options(words, option_names(arguments), prog)
    captured = io.StringIO()
    try:
        with contextlib.redirect_stderr(captured):
            return tyro.cli(
                arguments,
                default=default,
                args=list(words),
                prog=prog,
                config=(tyro.conf.DisallowNone,),
            )
    except SystemExit as stop:
        if not stop.code:
            raise
        raise UsageError(_explain(captured.getvalue(), words, arguments, prog)) from None


def option_names(arguments: type, prefix: str = "--") -> list[str]:
    """Every option of a command, sections included, as it is typed."""
    names = []
    hints = typing.get_type_hints(arguments)
    for field in dataclasses.fields(arguments):
        name = field.name.replace("_", "-")
        if dataclasses.is_dataclass(hints[field.name]):
            names += option_names(typing.cast(type, hints[field.name]), f"{prefix}{name}.")
        else:
            names.append(prefix + name)
            if hints[field.name] is bool:
                names.append(f"{prefix}no-{name}")
    return names


def wants_help(words: Sequence[str]) -> bool:
    """Whether help is asked for."""
    return any(word in ("-h", "--help") for word in words)


def _check_options(words: Sequence[str], known: Sequence[str], prog: str) -> None:
    for word in words:
        option = word.partition("=")[0].replace("_", "-")
        if not option.startswith("--") or option in (*known, "--", "--help"):
            continue
        if option.startswith("--tyro-"):
            continue
        hint = closest(option, known)
        if not hint:
            tails = {name.rpartition(".")[2].lstrip("-"): name for name in known}
            near = difflib.get_close_matches(option.lstrip("-"), list(tails), n=1)
            hint = f" Did you mean {tails[near[0]]!r}?" if near else ""
        raise UsageError(f"unknown option {option!r}.{hint} `{prog} --help` lists all options.")


def _explain(output: str, words: Sequence[str], arguments: type, prog: str) -> str:
    """Shorten tyro's box to one line that says what, got and allowed."""
    lines = _box_lines(output)
    reason = one_line(" ".join(itertools.takewhile(lambda line: line != _RULE, lines)))
    see = f"`{prog} --help` explains."
    if reason.startswith("Missing from"):
        required = [
            field.name.upper()
            for field in dataclasses.fields(arguments)
            if field.default is dataclasses.MISSING and field.default_factory is dataclasses.MISSING
        ]
        return f"missing argument {' '.join(required)}. {see}"
    if reason.startswith("Unrecognized options:"):
        return f"unexpected argument {reason.partition(': ')[2]!r}. {see}"
    wrong = re.match(
        r"invalid choice '(.*)' for argument '(.*)'\. Expected one of \((.*)\)", reason
    )
    if wrong:
        got, name, choices = wrong[1], wrong[2], re.findall(r"'(.*?)'", wrong[3])
        name = name if name.startswith("-") else name.upper()
        hint = closest(got, choices)
        return f"{name} is {got!r}.{hint} Allowed: {', '.join(choices)}. {see}"
    found = re.match(r"Error parsing (--\S+): ", reason)
    if found:
        option = found[1]
        kinds = [line[len(option) :].strip() for line in lines if line.startswith(f"{option} ")]
        if kinds and kinds[0] in _ALLOWED:
            return f"{option} is {_given(option, words)!r}, allowed: {_ALLOWED[kinds[0]]}. {see}"
    return f"{reason.removeprefix('Error parsing ').rstrip('.')}. {see}"


def _box_lines(output: str) -> list[str]:
    """The text inside tyro's box, drawn with or without Unicode; rules become `_RULE`."""
    plain = re.sub(r"\x1b\[[0-9;]*m", "", output)
    lines = [line.strip("│ \t") for line in plain.splitlines()]
    lines = [_RULE if re.fullmatch(r"[-─]{10,}", line) else line for line in lines]
    if any(line.startswith("╭") for line in lines):
        return [line for line in lines if not line.startswith(("╭", "╰"))]
    return lines[lines.index(_RULE) + 1 :] if _RULE in lines else lines


def _given(option: str, words: Sequence[str]) -> str:
    """The words that followed an option."""
    given: list[str] = []
    taking = False
    for word in words:
        name, equals, value = word.partition("=")
        if name.startswith("--"):
            taking = name.replace("_", "-") == option
            given = ([value] if equals else []) if taking else given
        elif taking:
            given.append(word)
    return " ".join(given)
