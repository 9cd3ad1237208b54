"""Optimizers of action sequences. All but `ILQR` know nothing of models: a score is enough.

Each is a set of hyperparameters with pure methods. Actions are scaled to [-1, 1].
Environments are independent; they are searched side by side.
"""

from headway.config import PlannerConfig
from headway.planning.optimizers.base import Optimizer as Optimizer
from headway.planning.optimizers.cem import CEM as CEM
from headway.planning.optimizers.icem import ICEM as ICEM
from headway.planning.optimizers.ilqr import ILQR as ILQR
from headway.planning.optimizers.random_shooting import RandomShooting as RandomShooting

_OPTIMIZERS = {"cem": CEM, "icem": ICEM, "random-shooting": RandomShooting, "ilqr": ILQR}


def make_optimizer(config: PlannerConfig) -> Optimizer | ILQR:
    """Build the optimizer that the settings name."""
    own = {name: value for name, value in vars(config.optimizer).items() if name != "name"}
    return _OPTIMIZERS[config.optimizer.name](
        num_candidates=config.num_candidates, num_iterations=config.num_iterations, **own
    )
