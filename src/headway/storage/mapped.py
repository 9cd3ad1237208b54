"""Arrays that stay in their file: safetensors opened memory-mapped instead of loaded."""

from pathlib import Path

import numpy as np

from headway.storage import files
from headway.storage.arrays import Arrays, read_header


def map_arrays(path: Path) -> Arrays:
    """Open the arrays of a safetensors file as read-only views of the mapped file.

    Nothing but the header is read; a page is when it is touched, and the system takes it back
    when memory is short. All views share one mapping, which lives as long as one of them. The
    file may be replaced meanwhile, not shortened in place.

    Raises:
        RunError: The file is missing or damaged.
    """
    specs = read_header(path)  # checked against the file's size
    with files.open_file(path) as file:
        content = np.memmap(file, np.uint8, "r")
    return {
        name: np.ndarray(spec.shape, spec.dtype, buffer=content, offset=spec.offset)
        for name, spec in specs.items()
    }
