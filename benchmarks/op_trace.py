"""Records when each compiled operation ran, with JAX's profiler."""

import collections
import dataclasses
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import jax


class Operation(NamedTuple):
    """An operation of a compiled module; several modules have operations of one name."""

    module: str
    name: str


@dataclasses.dataclass(frozen=True)
class Span:
    """One run of one operation; times in seconds."""

    op: Operation
    start: float
    end: float


def record(function: Callable[[], Any]) -> list[Span]:
    """Call a function once and list the operations that it ran, in the order they began."""
    with tempfile.TemporaryDirectory() as folder:
        options = jax.profiler.ProfileOptions()
        options.python_tracer_level = 0
        with jax.profiler.trace(folder, profiler_options=options):
            jax.block_until_ready(function())
        (path,) = Path(folder).rglob("*.xplane.pb")
        events = _events(jax.profiler.ProfileData.from_file(str(path)))
    return sorted(_spans(events), key=lambda span: span.start)


def _events(data: Any) -> list[tuple[Any, dict[str, Any]]]:
    """All events; those of devices alone where there are any (a CPU's are the host's)."""
    planes = list(data.planes)
    devices = [plane for plane in planes if plane.name.startswith("/device:")]
    return [
        (event, dict(event.stats))
        for plane in devices or planes
        for line in plane.lines
        for event in line.events
    ]


def _spans(events: list[tuple[Any, dict[str, Any]]]) -> list[Span]:
    """Pair the events of operations that go on in other threads with their ends.

    On a CPU an event `end: NAME` consumes (`_c`) what the event NAME produced (`_p`).
    """
    ends = {
        stats["_c"]: event.start_ns
        for event, stats in events
        if event.name.startswith("end: ") and "_c" in stats
    }
    return [
        Span(
            Operation(str(stats.get("hlo_module", "")), str(stats["hlo_op"])),
            1e-9 * event.start_ns,
            1e-9 * max(event.end_ns, ends.get(stats.get("_p"), 0)),
        )
        for event, stats in events
        if "hlo_op" in stats
    ]


def exclusive_seconds(spans: list[Span]) -> dict[Operation, float]:
    """Split the time from first to last event over the operations.

    Of the operations under way, the one that began last has the time: operations nest (a loop
    and its body), and the end of a parallel one may be written down only after its successor
    has begun.
    """
    moments = sorted(
        [(span.start, True, i) for i, span in enumerate(spans)]
        + [(span.end, False, i) for i, span in enumerate(spans)]
    )
    seconds: dict[Operation, float] = collections.defaultdict(float)
    running: set[int] = set()
    before = moments[0][0]
    for now, starts, index in moments:
        if running:
            newest = max(running, key=lambda i: (spans[i].start, i))
            seconds[spans[newest].op] += now - before
        before = now
        running = running | {index} if starts else running - {index}
    return seconds
