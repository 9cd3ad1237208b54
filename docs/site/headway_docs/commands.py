"""`.. command:: train`: what `headway train --help` prints, as entries that can be linked."""

import contextlib
import io
import os
import re
from collections.abc import Iterator
from textwrap import indent
from unittest import mock

from docutils import nodes
from sphinx.util.docutils import SphinxDirective

from headway.cli import main

WIDTH = "80"  # columns; in more of them boxes stand side by side
SETTINGS = " options"  # ends the titles of the boxes that list settings


def help_of(command: str) -> str:
    """What a command prints when asked for help."""
    printed = io.TextIOWrapper(io.BytesIO(), encoding="utf-8")  # UTF-8 has boxes
    with (
        mock.patch.dict(os.environ, COLUMNS=WIDTH),
        contextlib.redirect_stdout(printed),
        contextlib.suppress(SystemExit),
    ):
        main([command, "--help"])
    printed.seek(0)
    return printed.read()


def boxes(text: str) -> Iterator[tuple[str, list[str]]]:
    """Titles and lines of the boxes in a help text."""
    for title, inside in re.findall(r"╭─ (.+?) ─+╮\n(.*?)╰", text, re.DOTALL):
        yield title, [line[2:].rstrip(" │") for line in inside.splitlines()]


def options(lines: list[str]) -> Iterator[tuple[str, str]]:
    """Options and what is said of them; their text begins behind them or in the next line."""
    name, text = "", ""
    for line in lines:
        if not line.startswith(" "):
            if name:
                yield name, text
            name, _, text = line.partition("  ")
        else:
            text += " " + line.strip()
    yield name, text.strip()


def as_literals(text: str) -> str:
    """Help says code in Markdown's single backticks, or as it is typed."""
    text = re.sub(r"(?<!`)`([^`]+)`(?!`)", r"``\1``", text)
    return re.sub(r"(?<![`\w-])(--[a-z][\w.-]*\w)", r"``\1``", text)


def entries(command: str) -> str:
    """A command and its options, as reStructuredText."""
    text = help_of(command)
    usage, _, about = text.partition("╭")[0].partition("\n")
    parts = [f"::\n\n   {usage.removeprefix('usage: ')}", as_literals(about.strip())]
    parts.append(f".. program:: headway {command}")
    settings = []
    for title, lines in boxes(text):
        if title.endswith(SETTINGS):
            settings.append(f":ref:`{title.removesuffix(SETTINGS)} <settings-{title.split()[0]}>`")
            continue
        for name, said in options(lines):
            if not name.startswith("-h,"):
                parts.append(f".. option:: {name}\n\n{indent(as_literals(said), '   ')}")
    if settings:
        parts.append(f"Every setting of {', '.join(settings)} is an option too.")
    return "\n\n".join([*parts, ""])


class Command(SphinxDirective):
    """Document a command of `headway`."""

    required_arguments = 1

    def run(self) -> list[nodes.Node]:
        """Ask the command for its help."""
        return self.parse_text_to_nodes(entries(self.arguments[0]))


def setup(app) -> None:
    """Connect to Sphinx."""
    app.add_directive("command", Command)
