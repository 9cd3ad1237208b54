"""Several runs, each in a thread of its own, whose networks run in one program.

A run goes through its own training loop and knows nothing of the others. Where it comes to a
function that runs the networks, it waits for them (`jit_networks` brings it here). Calls that
are alike are stacked along a new leading axis, the seeds, computed by one compiled program, on a
CPU a few at a time, and handed back. So a run that ends or fails leaves the others to go on, and
one that does something else for a while, such as an epoch with a smaller step, is computed by
itself.
"""

import dataclasses
import functools
import threading
from collections import defaultdict
from collections.abc import Callable, Sequence
from contextvars import ContextVar, Token
from typing import Any, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp

SEEDS = "seed"
"""Name of the mapped axis."""
MOST_ON_CPU = 4
"""Runs that one program computes on a CPU; more of them cost more each (docs/performance.md)."""

Item = TypeVar("Item")
Position = tuple[int, int]
"""How far a run is: its iteration, and what it does in it; those that are behind go first."""

_BEFORE_ALL: Position = (-1, 0)
_seat: ContextVar["Seat | None"] = ContextVar("seat", default=None)


def seat_here() -> "Seat | None":
    """The seat of the run that this thread belongs to; None where a run is alone."""
    return _seat.get()


def seeds_at_once() -> int:
    """How many seeds the program that is being traced is mapped over; 1 where it is not."""
    try:
        return jax.lax.axis_size(SEEDS)
    except NameError:
        return 1


class MeetingClosedError(RuntimeError):
    """The other runs were torn out of their work, and so this one is."""


class Program:
    """A pure function of pytrees, compiled for one run or for several of them.

    Args:
        function: Takes and returns pytrees of arrays; what is no array fixes the program.
        options: Asked for when it is first called: those of `equinox.filter_jit`.
    """

    def __init__(self, function: Callable, options: Callable[[], dict[str, Any]]):
        self._function, self._options = function, options
        self._wrapping = threading.Lock()

    @property
    def alone(self) -> Callable:
        """The function itself, compiled; whichever threads ask first, there is one."""
        with self._wrapping:
            return self._alone

    @functools.cached_property
    def _alone(self) -> Callable:
        return eqx.filter_jit(self._function, **self._options())

    @functools.cached_property
    def _mapped(self) -> Callable:
        return eqx.filter_jit(_over_seeds(self._function), **self._options())

    def together(self, arguments: Any) -> Any:
        """The results of several runs, stacked as their arguments are."""
        return self._mapped(arguments)


def _over_seeds(function: Callable) -> Callable:
    """A function of stacked positional and named arguments."""

    def of_one(arguments: tuple[tuple, dict]) -> Any:
        return function(*arguments[0], **arguments[1])

    return eqx.filter_vmap(of_one, axis_name=SEEDS)


@dataclasses.dataclass(eq=False)
class Call:
    """A call that waits to be computed."""

    program: Program
    args: tuple
    kwargs: dict[str, Any]
    begun: bool = False
    over: bool = False
    result: Any = None
    error: BaseException | None = None

    @property
    def kind(self) -> Any:
        """Equal for calls that one program can compute together."""
        leaves, structure = jax.tree.flatten((self.args, self.kwargs))
        return self.program, structure, tuple(map(_kind_of_leaf, leaves))

    def end(self, result: Any, error: BaseException | None = None) -> None:
        """Note how it went."""
        self.result, self.error, self.over = result, error, True


def _kind_of_leaf(leaf: Any) -> Any:
    return (leaf.shape, leaf.dtype) if eqx.is_array(leaf) else leaf


class Meeting:
    """Where runs wait for each other. Leaving it as a context manager stops them all."""

    def __init__(self):
        self._changed = threading.Condition()
        self._seats: list[Seat] = []
        self._stacks: dict[int, _Stacks] = defaultdict(_Stacks)
        """Of each group, counted within a round: it is mostly of the same runs."""
        self._closed = False

    def __enter__(self) -> "Meeting":
        return self

    def __exit__(self, kind: Any, error: Any, trace: Any) -> None:
        """Let nobody wait any more."""
        with self._changed:
            self._closed = True
            self._changed.notify_all()

    def take_seat(self) -> "Seat":
        """A place for one more run; the others wait for it from now on."""
        seat = Seat(self)
        self._seats.append(seat)
        return seat

    def change(self, seat: "Seat", position: Position | None) -> None:
        """Let a run move on, or leave."""
        with self._changed:
            if position is None:
                self._seats.remove(seat)
            else:
                seat.position = position
            self._changed.notify_all()

    def compute(self, seat: "Seat", call: Call) -> Any:
        """Wait until every run that is not ahead waits too; then the calls are computed.

        Raises:
            MeetingClosedError: Nobody waits any more.
        """
        with self._changed:
            seat.call = call
            self._changed.notify_all()
            while not call.over:
                if self._closed:
                    raise MeetingClosedError
                due = self._due()
                if due:
                    self._run(due)
                else:
                    self._changed.wait()
        if call.error is not None:
            raise call.error
        return call.result

    def _due(self) -> list[Call]:
        """The calls of those who are least far, once all of them have come."""
        least = min(seat.position for seat in self._seats)
        calls = [seat.call for seat in self._seats if seat.position == least]
        waiting = [call for call in calls if call is not None and not (call.begun or call.over)]
        return waiting if len(waiting) == len(calls) else []

    def _run(self, calls: Sequence[Call]) -> None:
        """Compute in this thread, while the others may come and go."""
        for call in calls:
            call.begun = True
        self._changed.release()
        try:
            groups = [group for alike in _by_kind(calls) for group in in_groups(alike)]
            for place, group in enumerate(groups):
                self._compute_together(group, self._stacks[place])
        except BaseException as error:  # some could not be compared; nobody may wait for them
            for call in calls:
                if not call.over:
                    call.end(None, error)
        finally:
            self._changed.acquire()
            self._changed.notify_all()

    def _compute_together(self, calls: Sequence[Call], stacks: "_Stacks") -> None:
        try:
            results = self._results(calls, stacks)
        except BaseException as error:  # each run answers for itself
            for call in calls:
                call.end(None, error)
            return
        for call, result in zip(calls, results, strict=True):
            call.end(result)

    def _results(self, calls: Sequence[Call], stacks: "_Stacks") -> Sequence[Any]:
        first = calls[0]
        if len(calls) == 1:
            return [first.program.alone(*first.args, **first.kwargs)]
        columns = zip(*(call.args for call in calls), strict=True)
        args = tuple(stacks.of(column) for column in columns)
        kwargs = {name: stacks.of([call.kwargs[name] for call in calls]) for name in first.kwargs}
        stacked = first.program.together((args, kwargs))
        return stacks.taken_apart(stacked, len(calls))


def _by_kind(calls: Sequence[Call]) -> list[list[Call]]:
    """Those that one program computes, together."""
    groups: dict[Any, list[Call]] = {}
    for call in calls:
        groups.setdefault(call.kind, []).append(call)
    return list(groups.values())


def in_groups(items: Sequence[Item]) -> list[Sequence[Item]]:
    """Those that one program computes at once: all, or on a CPU at most `MOST_ON_CPU`."""
    most = MOST_ON_CPU if jax.default_backend() == "cpu" else len(items)
    groups = -(-len(items) // most)
    size = -(-len(items) // groups)
    return [items[first : first + size] for first in range(0, len(items), size)]


class Seat:
    """A run's place in a meeting; a context manager around the run, in the run's thread."""

    def __init__(self, meeting: Meeting):
        self.position = _BEFORE_ALL
        self.call: Call | None = None
        self._meeting = meeting
        self._token: Token | None = None

    def __enter__(self) -> "Seat":
        self._token = _seat.set(self)
        return self

    def __exit__(self, kind: Any, error: Any, trace: Any) -> None:
        """Leave; nobody waits for this run any more."""
        if self._token is not None:
            _seat.reset(self._token)
        self._meeting.change(self, None)

    def move(self, position: Position) -> None:
        """Say how far the run is; those that are behind it no longer wait for it."""
        self._meeting.change(self, position)

    def compute(self, program: Program, args: tuple, kwargs: dict[str, Any]) -> Any:
        """Call a program, together with the other runs."""
        return self._meeting.compute(self, Call(program, args, kwargs))


class _Stacks:
    """Stacks arguments, and takes results apart.

    What went into the last program or came out of it is known: weights that stay the same from
    step to step are not stacked again, nor are results that are the next arguments.
    """

    def __init__(self):
        self._known: dict[tuple[int, ...], tuple[Sequence[Any], Any]] = {}
        self._used: dict[tuple[int, ...], tuple[Sequence[Any], Any]] = {}

    def of(self, trees: Sequence[Any]) -> Any:
        """One tree with a leading axis of seeds."""
        name = tuple(map(id, trees))
        # The trees are kept, so that nothing else can have their ids.
        found = self._known.get(name) or (trees, stack(trees))
        self._used[name] = found
        return found[1]

    def taken_apart(self, stacked: Any, number: int) -> list[Any]:
        """A result for each run."""
        self._known, self._used = self._used, {}
        results = _take_apart(stacked, number)
        if isinstance(stacked, tuple):
            for whole, *parts in zip(stacked, *results, strict=True):
                self._known[tuple(map(id, parts))] = (parts, whole)
        return results


def stack(trees: Sequence[Any]) -> Any:
    """One tree of longer arrays; what is no array is the same in all of them."""
    fixed = eqx.filter(trees[0], eqx.is_array, inverse=True)
    return eqx.combine(_stack_arrays([eqx.filter(tree, eqx.is_array) for tree in trees]), fixed)


@jax.jit
def _stack_arrays(trees: Sequence[Any]) -> Any:
    return jax.tree.map(lambda *leaves: jnp.stack(leaves), *trees)


def _take_apart(stacked: Any, number: int) -> list[Any]:
    """The trees that were stacked."""
    fixed = eqx.filter(stacked, eqx.is_array, inverse=True)
    parts = _rows(eqx.filter(stacked, eqx.is_array), number)
    return [eqx.combine(part, fixed) for part in parts]


@functools.partial(jax.jit, static_argnums=1)
def _rows(stacked: Any, number: int) -> list[Any]:
    return [jax.tree.map(lambda x, i=i: x[i], stacked) for i in range(number)]
