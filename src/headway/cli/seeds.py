"""Seeds as they are typed."""

import re
from collections.abc import Sequence

from headway.cli.usage import UsageError

MAX_SEEDS = 1000


def read_seeds(words: Sequence[str]) -> tuple[int, ...]:
    """Read seeds and ranges, for example `0:3` or `0 4`.

    Raises:
        UsageError: A word is neither.
    """
    seeds: list[int] = []
    for word in words:
        found = re.fullmatch(r"(\d{1,10})(?::(\d{1,10}))?", word)
        if not found:
            raise UsageError(f"--seeds is {word!r}, allowed: whole numbers, or ranges as 0:3.")
        first = int(found[1])
        last = int(found[2]) if found[2] else first + 1
        if last <= first:
            raise UsageError(
                f"--seeds is {word!r}, a range of no seeds, allowed: first:last, where last is the"
                " larger and left out."
            )
        if last - first > MAX_SEEDS:
            raise UsageError(f"--seeds is {word!r}, allowed: 1 to {MAX_SEEDS} seeds.")
        seeds += range(first, last)
    return tuple(seeds)
