"""From settings to an optimizer."""

import dataclasses

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
    """Build the optimizer that the settings name; its fields are the settings of those names."""
    optimizer = _OPTIMIZERS[config.optimizer]
    fields = dataclasses.fields(optimizer)
    return optimizer(**{field.name: getattr(config, field.name) for field in fields})
