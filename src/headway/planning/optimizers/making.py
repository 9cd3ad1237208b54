"""From settings to an optimizer."""

from typing import Any

from headway.config import PlannerConfig
from headway.planning.optimizers.base import Optimizer
from headway.planning.optimizers.cem import CEM
from headway.planning.optimizers.icem import ICEM
from headway.planning.optimizers.mppi import MPPI
from headway.planning.optimizers.shooting import RandomShooting

_OPTIMIZERS: dict[str, type[Optimizer]] = {
    "cem": CEM,
    "icem": ICEM,
    "mppi": MPPI,
    "random-shooting": RandomShooting,
}


def make_optimizer(config: PlannerConfig) -> Optimizer:
    """Build the optimizer that the settings name."""
    settings: dict[str, Any] = dict(vars(config.optimizer))
    optimizer = _OPTIMIZERS[settings.pop("name")]
    shared = {"num_candidates": config.num_candidates, "num_iterations": config.num_iterations}
    return optimizer(**shared, **settings)
