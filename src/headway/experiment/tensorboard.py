"""A run's numbers for TensorBoard."""

import tempfile
from pathlib import Path
from typing import Any

from headway.storage import files
from headway.storage.manifest import inside


def write_tensorboard(run_dir: Path, metrics: dict[str, Any]) -> None:
    """Write one iteration's numbers, over environment steps.

    One file per iteration, which is replaced when an interrupted iteration is done again.
    """
    from tensorboardX import SummaryWriter

    with tempfile.TemporaryDirectory() as folder:
        with SummaryWriter(folder) as writer:
            for section in ("collection", "fitting", "evaluation", "seconds"):
                for name, value in metrics.get(section, {}).items():
                    number = value["return_mean"] if isinstance(value, dict) else value
                    if isinstance(number, int | float):
                        writer.add_scalar(f"{section}/{name}", number, metrics["timesteps"])
        (events,) = Path(folder).iterdir()
        name = f"events.out.tfevents.{metrics['iteration']:010d}.headway"
        files.write_bytes(inside(run_dir, f"tensorboard/{name}"), events.read_bytes())
