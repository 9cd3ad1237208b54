"""Optimizers of action sequences. They know nothing of models: a score function is all.

Each is a set of hyperparameters with pure methods. Actions are scaled to [-1, 1].
Environments are independent; they are searched side by side.
"""

from headway.planning.optimizers.base import Optimizer as Optimizer
from headway.planning.optimizers.base import Plan as Plan
from headway.planning.optimizers.base import Score as Score
from headway.planning.optimizers.base import SearchState as SearchState
from headway.planning.optimizers.base import where_env as where_env
from headway.planning.optimizers.cem import CEM as CEM
from headway.planning.optimizers.icem import ICEM as ICEM
from headway.planning.optimizers.making import make_optimizer as make_optimizer
from headway.planning.optimizers.mppi import MPPI as MPPI
from headway.planning.optimizers.ranking import rank_non_finite_last as rank_non_finite_last
from headway.planning.optimizers.shooting import RandomShooting as RandomShooting
