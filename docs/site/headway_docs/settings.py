"""`.. settings:: planner`: every setting of a section with its type, default and description."""

import dataclasses
import inspect
import typing
from textwrap import indent

from docutils import nodes
from sphinx.pycode import ModuleAnalyzer
from sphinx.util.docutils import SphinxDirective
from sphinx.util.typing import stringify_annotation

from headway.config import Config


def entries(section: str) -> str:
    """The section's class and its settings, as reStructuredText."""
    config = typing.get_type_hints(Config)[section]
    hints, name = typing.get_type_hints(config), config.__name__
    texts = ModuleAnalyzer.for_module(config.__module__).find_attr_docs()
    parts = [
        f".. py:class:: headway.config.{name}\n\n{indent(inspect.getdoc(config) or '', '   ')}",
        f".. py:currentmodule:: {section}",
    ]
    for field in dataclasses.fields(config):
        text = "\n".join(texts[name, field.name])
        parts.append(
            f".. py:attribute:: {field.name}\n"
            f"   :type: {stringify_annotation(hints[field.name], 'smart')}\n"
            f"   :value: {field.default!r}\n\n{indent(text, '   ')}"
        )
    return "\n\n".join([*parts, ".. py:currentmodule:: None", ""])


class Settings(SphinxDirective):
    """Document a section of the settings."""

    required_arguments = 1

    def run(self) -> list[nodes.Node]:
        """Read the settings from the library."""
        return self.parse_text_to_nodes(entries(self.arguments[0]))


def setup(app) -> None:
    """Connect to Sphinx."""
    app.add_directive("settings", Settings)
