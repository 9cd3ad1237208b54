"""What a page is made of, before it is laid out."""

import dataclasses
import zlib
from collections.abc import Sequence


@dataclasses.dataclass(frozen=True)
class Panel:
    """One small figure."""

    title: str
    svg: str
    caption: str = ""


@dataclasses.dataclass(frozen=True)
class Cell:
    """A table's cell: a main text and fainter ones below."""

    text: str
    below: Sequence[str] = ()
    is_number: bool = False
    is_code: bool = False
    is_key: bool = False
    """Whether the symbol of the line's series stands before it."""


@dataclasses.dataclass(frozen=True)
class Line:
    """A table's line; one that belongs to a series hides with it."""

    cells: Sequence[Cell]
    series: int | None = None


@dataclasses.dataclass(frozen=True)
class Table:
    """A table; wide ones scroll by themselves."""

    columns: Sequence[str]
    lines: Sequence[Line]


@dataclasses.dataclass(frozen=True)
class Block:
    """A part of a section, mostly one environment."""

    title: str = ""
    panels: Sequence[Panel] = ()
    table: Table | None = None
    texts: Sequence[str] = ()
    claims: Sequence[str] = ()
    """What follows from the table, one sentence each."""


@dataclasses.dataclass(frozen=True)
class Section:
    """A chapter of the page, with the command that makes it alone."""

    name: str
    title: str
    lead: str
    blocks: Sequence[Block]
    command: str = ""
    csv: str = ""
    """Text to copy."""


def identifier(*words: str) -> str:
    """A name for a figure that holds letters, digits and hyphens, whatever the words hold."""
    plain = "-".join("".join(c if c.isascii() and c.isalnum() else "_" for c in w) for w in words)
    return f"{plain}-{zlib.crc32(repr(words).encode()):x}"
