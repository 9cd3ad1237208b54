"""Arrays that stay in their file: safetensors opened memory-mapped instead of loaded."""

import json
from pathlib import Path
from typing import Any

import numpy as np
from safetensors import SafetensorError, safe_open

from headway.errors import RunError

DTYPES = {"F32": np.dtype("<f4"), "F64": np.dtype("<f8")}  # what trajectories are made of


def map_arrays(path: Path) -> dict[str, np.ndarray]:
    """Open the arrays of a safetensors file as read-only views of the mapped file.

    Nothing but the header is read; a page is when it is touched, and the system takes it back
    when memory is short. All views share one mapping, which lives as long as one of them. The
    file may be replaced meanwhile, not shortened in place.

    Raises:
        RunError: The file is missing, damaged, or holds something else than float arrays.
    """
    try:
        with safe_open(path, framework="numpy"):  # checks the header against the file's size
            content = np.memmap(path, np.uint8, "r")
        start = 8 + int.from_bytes(content[:8].tobytes(), "little")
        header = json.loads(content[8:start].tobytes())
        header.pop("__metadata__", None)
        return {name: _view(content, start, entry) for name, entry in header.items()}
    except FileNotFoundError:
        raise RunError(f"{path} is missing; the run is not complete.") from None
    except (SafetensorError, KeyError, OSError) as error:
        raise RunError(
            f"{path} is damaged ({error}), allowed: safetensors of F32 and F64; restore the file or"
            " start anew in another directory."
        ) from None


def _view(content: np.memmap, start: int, entry: dict[str, Any]) -> np.ndarray:
    first, _ = entry["data_offsets"]
    return np.ndarray(entry["shape"], DTYPES[entry["dtype"]], buffer=content, offset=start + first)
