"""Every setting of a run: frozen, typed, checked, and written to JSON as it is.

Defaults are the paper's (supplement A.2, A.3); where the paper is silent they follow the
released code. A setting is addressed as `section.name`, for example `planner.horizon`.
"""

from headway.config.fitting import FittingConfig
from headway.config.model import PLAIN, ContextKind, ModelConfig, Precision
from headway.config.planner import PlannerConfig
from headway.config.protocol import CollectionConfig, EvaluationConfig
from headway.config.run import Config

__all__ = [
    "PLAIN",
    "CollectionConfig",
    "Config",
    "ContextKind",
    "EvaluationConfig",
    "FittingConfig",
    "ModelConfig",
    "PlannerConfig",
    "Precision",
]
