"""Folders that say which comparison they hold, so that none replaces another one's results.

A comparison may replace one that it contains, such as itself with fewer seeds. Where there is
another one, it goes to a folder beside, which is named by all that it compares.
"""

import hashlib
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from headway.training.run import write_json

NOTE = "comparison.json"
GROWING = ("envs", "seeds", "arms")  # what the same comparison may have more of

Facts = Mapping[str, Any]
"""What is compared, as plain values."""


def choose(usual: Path, facts: Facts) -> Path:
    """The folder of a comparison: the usual one, unless that holds another comparison.

    Args:
        usual: Named by the experiment and the preset.
        facts: What is compared.
    """
    if (usual / NOTE).exists() and not _may_replace(usual, facts):
        text = json.dumps(_plain(facts), sort_keys=True)
        digest = hashlib.sha256(text.encode()).hexdigest()
        return usual.with_name(f"{usual.name}-{digest[:10]}")
    return usual


def claim(folder: Path, facts: Facts) -> None:
    """Note what a folder holds."""
    write_json(folder / NOTE, _plain(facts))


def _may_replace(folder: Path, facts: Facts) -> bool:
    """Whether all that a folder holds is among what is compared now."""
    try:
        before = json.loads((folder / NOTE).read_bytes())
        now = _plain(facts)
        fixed = now.keys() - set(GROWING)
        same = all(before[name] == now[name] for name in fixed)
        return same and all(one in now[name] for name in GROWING for one in before[name])
    except (OSError, ValueError, KeyError, TypeError):  # whatever it is, it is not ours
        return False


def _plain(facts: Facts) -> dict[str, Any]:
    """The facts as they are read from a file."""
    return json.loads(json.dumps(facts, default=str))
