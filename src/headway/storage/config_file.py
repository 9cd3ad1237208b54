"""The file `config.json` of a run: schema, settings, versions, device, commit."""

import importlib.metadata
import platform
from pathlib import Path
from typing import Any

import jax

from headway import settings
from headway.config import Config
from headway.errors import RunError
from headway.storage import checkout, files

SCHEMA = 2  # of a run directory
UNCHECKED = 1  # the schema before there were checksums
MAX_BYTES = 2**20
VERSIONED = ("headway", "jax", "jaxlib", "equinox", "optax", "numpy", "gymnasium", "mujoco")


def content(config: Config) -> bytes:
    """The file of a new run."""
    values = {
        "schema": SCHEMA,
        "config": settings.to_dict(config),
        "versions": {
            "python": platform.python_version(),
            **{name: importlib.metadata.version(name) for name in VERSIONED},
        },
        "device": str(jax.devices()[0].device_kind),
    }
    commit = checkout.commit()
    return files.seal(values if commit is None else {**values, "commit": commit})


def read(path: Path) -> dict[str, Any]:
    """Read it, of this schema or the one before.

    Raises:
        RunError: The file is missing, damaged, or of another schema.
    """
    values = files.read_json(path, MAX_BYTES)
    schema = values.get("schema") if isinstance(values, dict) else None
    if schema == UNCHECKED:
        return values
    if schema == SCHEMA:
        return files.read_sealed(path)
    newer = type(schema) is int and schema > SCHEMA
    advice = "update headway" if newer else "restore the file or train the run again"
    raise RunError(
        f"{path} has schema {str(schema)[:20]}, allowed: {UNCHECKED} or {SCHEMA}; {advice}."
    )
