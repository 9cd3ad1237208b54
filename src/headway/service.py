"""A trained run in service. Importing this brings in no simulator."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from headway.experiment.methods import config_to_control
from headway.models.compilation import prepare_jax
from headway.planning.controller import Controller
from headway.training.loading import load_agent
from headway.training.run import RunDir


def load(
    run_dir: str | Path,
    *,
    seed: int = 0,
    settings: Mapping[str, Any] | None = None,
    **options: Any,
) -> Controller:
    """Load the controller of a run.

    Args:
        run_dir: The run directory.
        seed: Seeds the planner's draws.
        settings: Changes of `planner` settings by dotted name, for example
            `{"planner.num_candidates": 50}`, to control with another planner.
        options: Those of `Controller`, for example `deadline_ms=50`.

    Raises:
        RunError: There is no trained run, or it is damaged.
        ConfigError: A setting is unknown, of the wrong type or out of range, or none of the
            planner's; or as `Controller`.
    """
    prepare_jax()
    run = RunDir(run_dir)
    config = config_to_control(run.config(), settings or {})
    return Controller(load_agent(run, config), seed=seed, **options)
