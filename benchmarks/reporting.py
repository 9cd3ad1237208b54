"""Collects what one run has measured, and writes it as JSON and as a Markdown table."""

import dataclasses
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from machine import facts
from targets import Target

LATEST = Path(__file__).parent / "latest"
NOT_MEASURED = "not measured"


@dataclasses.dataclass(frozen=True)
class Measurement:
    """One line of the table; `key` finds its target."""

    name: str
    value: float
    unit: str
    ratio: float | None = None
    ratio_to: str = ""
    key: str = ""


class Report:
    """What one run has measured, beside what is wanted."""

    def __init__(self, targets: Sequence[Target]):
        self.targets = targets
        self.measurements: list[Measurement] = []

    def add(self, *args: Any, **kwargs: Any) -> None:
        """Add one line; see `Measurement`."""
        self.measurements.append(Measurement(*args, **kwargs))

    def rows(self, backend: str) -> list[dict[str, Any]]:
        """All measurements with their targets, then the targets that nothing was measured for.

        Args:
            backend: JAX's name of what was measured on; targets for others stay open.
        """
        wanted = {target.key: target for target in self.targets if target.backend == backend}
        rows = [_row(one, wanted.get(one.key)) for one in self.measurements]
        measured = {(backend, one.key) for one in self.measurements}
        return rows + [
            {"name": f"{target.row} ({target.backend.upper()})", "target": target.text}
            for target in self.targets
            if (target.backend, target.key) not in measured
        ]

    def write(self, name: str) -> str:
        """Write `NAME.json` and `NAME.md` into the folder `latest`; returns the table."""
        about = facts()
        rows = self.rows("cpu" if about["device"].endswith("(cpu)") else "gpu")
        table = markdown_table(
            ["what", "median", "ratio", "to", "target", "met"], [_cells(row) for row in rows]
        )
        return write_result(name, about, {"measurements": rows}, table)


def write_result(name: str, about: dict[str, Any], result: dict[str, Any], table: str) -> str:
    """Write facts and result as JSON, facts and table as Markdown; returns the Markdown."""
    LATEST.mkdir(exist_ok=True)
    text = f"{headline(about)}\n\n{table}\n"
    (LATEST / f"{name}.json").write_text(json.dumps({**about, **result}, indent=1) + "\n")
    (LATEST / f"{name}.md").write_text(text)
    return text


def headline(about: dict[str, Any]) -> str:
    """The facts in one paragraph."""
    return "; ".join(f"{name.replace('_', ' ')} {value}" for name, value in about.items()) + "."


def markdown_table(header: list[str], rows: list[list[str]]) -> str:
    """A table with aligned columns."""
    widths = [max(len(row[i]) for row in [header, *rows]) for i in range(len(header))]
    lines = [header, ["-" * width for width in widths], *rows]
    return "\n".join(
        "| " + " | ".join(cell.ljust(w) for cell, w in zip(line, widths, strict=True)) + " |"
        for line in lines
    )


def _row(one: Measurement, target: Target | None) -> dict[str, Any]:
    row = dataclasses.asdict(one)
    if target is None:
        return row
    return {**row, "target": target.text, "met": target.is_met(getattr(one, target.column))}


def _cells(row: dict[str, Any]) -> list[str]:
    measured = "value" in row
    return [
        row["name"],
        f"{row['value']:.4g} {row['unit']}" if measured else NOT_MEASURED,
        f"{row['ratio']:.2f}×" if row.get("ratio") is not None else "",
        row.get("ratio_to", ""),
        row.get("target", ""),
        {True: "met", False: "not met", None: ""}[row.get("met")],
    ]
