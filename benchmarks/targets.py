"""What the project wants to reach, to stand beside what was measured.

Plans and updates are those of the paper's HalfCheetah: 5 CEM iterations of 200 candidates of
20 particles over 30 steps, and 5 members of 4 x 200 units. A ratio is a time over the time of the
same operations at the rate of matrix products that was measured in the same run.
"""

import dataclasses
from typing import Literal


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

RUN_TARGETS = (
    Target("run-half-cheetah", "gpu", "HalfCheetah, the paper's run", 6.0, "value", "min"),
    Target("run-pendulum", "gpu", "Pendulum, the paper's run", 90.0, "value", "s"),
)
