"""Measurements of one run beside what is wanted, written as JSON and as a Markdown table.

Plans and updates are those of the paper's HalfCheetah: 5 CEM iterations of 200 candidates of
20 particles over 30 steps, and 5 members of 4 x 200 units. A ratio is a time over the time of the
same operations at the rate of matrix products that was measured in the same run.
"""

import dataclasses
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Literal

from machine import facts


@dataclasses.dataclass(frozen=True)
class Target:
    """A limit for one row of the table.

    `key` and `backend` say which measurement it is for; `column` says which figure of it.
    """

    key: str
    backend: Literal["cpu", "gpu"]
    row: str
    limit: float
    column: Literal["value", "ratio"]
    unit: str
    sense: Literal["at most", "at least"] = "at most"

    @property
    def text(self) -> str:
        """The limit, for readers."""
        sign = "≤" if self.sense == "at most" else "≥"
        return f"{sign} {self.limit:g}{'×' if self.column == 'ratio' else f' {self.unit}'}"

    def is_met(self, figure: float) -> bool:
        """Whether a figure keeps the limit."""
        return figure <= self.limit if self.sense == "at most" else figure >= self.limit


TARGETS = (
    Target("plan-1-bfloat16", "cpu", "plan, 1 env, bfloat16", 0.8, "ratio", ""),
    Target("plan-1-float32", "cpu", "plan, 1 env, float32", 1.6, "ratio", ""),
    Target("plan-10-bfloat16", "cpu", "plan, 10 env, bfloat16", 0.7, "ratio", ""),
    Target("update-float32", "cpu", "one update, float32", 10.0, "value", "ms"),
    Target("update-bfloat16", "cpu", "one update, bfloat16", 10.0, "value", "ms"),
    Target("memory", "cpu", "plan, 10 env, peak memory of the process", 1.5, "value", "GiB"),
    Target("first-plan-cold", "cpu", "first plan of a process, no cache", 10.0, "value", "s"),
    Target("first-plan-warm", "cpu", "first plan of a process, cached", 10.0, "value", "s"),
    Target("plan-10-bfloat16", "gpu", "plan, 10 env, bfloat16", 4.0, "ratio", ""),
    Target("updates-float32", "gpu", "updates per second", 6000.0, "value", "/s", "at least"),
    Target("first-plan-cold", "gpu", "first plan of a process, no cache", 20.0, "value", "s"),
    Target("first-plan-warm", "gpu", "first plan of a process, cached", 20.0, "value", "s"),
)


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
