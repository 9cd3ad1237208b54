"""Results on stdout: tables for people, one JSON line for programs."""

import json
import sys
from typing import Any

PIPE_WIDTH = 130


def print_tables(*tables: Any) -> None:
    """Print rich tables, or text, as wide as the terminal."""
    from rich.console import Console

    console = Console(width=None if sys.stdout.isatty() else PIPE_WIDTH, highlight=False)
    for table in tables:
        console.print(table)


def print_json(facts: dict[str, Any]) -> int:
    """Print one JSON line; returns the exit code of success."""
    print(json.dumps(facts, allow_nan=False))
    return 0
