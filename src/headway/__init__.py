"""Headway: control that keeps making headway when the physics changes.

    run = headway.train("pendulum", preset="quick", seed=0)
    controller = headway.load(run.path)
    action = controller.act(obs)

Names are loaded when first used, so `import headway` is quick and brings in no simulator.
"""

import importlib
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from headway.api import Evaluation as Evaluation
    from headway.api import Run as Run
    from headway.api import evaluate as evaluate
    from headway.api import train as train
    from headway.api import train_seeds as train_seeds
    from headway.config import Config as Config
    from headway.data import ReplayBuffer as ReplayBuffer
    from headway.data import Trajectory as Trajectory
    from headway.errors import BadEnvironmentError as BadEnvironmentError
    from headway.errors import BrokenEpisodeError as BrokenEpisodeError
    from headway.errors import BusyError as BusyError
    from headway.errors import ConfigError as ConfigError
    from headway.errors import DivergenceError as DivergenceError
    from headway.errors import HeadwayError as HeadwayError
    from headway.errors import LimitError as LimitError
    from headway.errors import PlanningError as PlanningError
    from headway.errors import RunError as RunError
    from headway.errors import SeedsError as SeedsError
    from headway.errors import UnknownNameError as UnknownNameError
    from headway.experiment.learners import Fit as Fit
    from headway.experiment.learners import Learned as Learned
    from headway.experiment.learners import Learner as Learner
    from headway.experiment.learners import register_learner as register_learner
    from headway.experiment.methods import METHODS as METHODS
    from headway.experiment.methods import Method as Method
    from headway.experiment.methods import make_config as make_config
    from headway.experiment.methods import register_method as register_method
    from headway.experiment.presets import PRESETS as PRESETS
    from headway.models.dynamics import MultiHeadDynamics as MultiHeadDynamics
    from headway.models.updates import EpochStats as EpochStats
    from headway.planning.agent import Agent as Agent
    from headway.planning.controller import Controller as Controller
    from headway.planning.meta.agent import AdaptiveAgent as AdaptiveAgent
    from headway.planning.meta.function import FunctionModel as FunctionModel
    from headway.planning.optimizers import CEM as CEM
    from headway.planning.optimizers import ICEM as ICEM
    from headway.planning.optimizers import MPPI as MPPI
    from headway.planning.optimizers import RandomShooting as RandomShooting
    from headway.report.diagnosis import Diagnosis as Diagnosis
    from headway.report.diagnosis import diagnose as diagnose
    from headway.report.dynamics import plot_dynamics as plot_dynamics
    from headway.report.page.build import write_report as write_report
    from headway.report.recording import Recording as Recording
    from headway.report.recording import record as record
    from headway.service import load as load
    from headway.sim_params import SimParamSets as SimParamSets
    from headway.storage.run_dir import RunDir as RunDir
    from headway.storage.tables import EpisodeRow as EpisodeRow
    from headway.tasks.base import Task as Task
    from headway.tasks.catalog import EnvSpec as EnvSpec
    from headway.tasks.catalog import env_spec as env_spec
    from headway.tasks.catalog import register as register

__version__ = "0.1.0"

_HOME = {
    "api": ("Evaluation", "Run", "evaluate", "train", "train_seeds"),
    "config": ("Config",),
    "data": ("ReplayBuffer", "Trajectory"),
    "errors": (
        "ConfigError",
        "DivergenceError",
        "BadEnvironmentError",
        "BrokenEpisodeError",
        "BusyError",
        "HeadwayError",
        "LimitError",
        "PlanningError",
        "RunError",
        "SeedsError",
        "UnknownNameError",
    ),
    "experiment.learners": ("Fit", "Learned", "Learner", "register_learner"),
    "experiment.methods": ("METHODS", "Method", "make_config", "register_method"),
    "experiment.presets": ("PRESETS",),
    "models.dynamics": ("MultiHeadDynamics",),
    "models.fitting": ("EpochStats",),
    "planning.agent": ("Agent",),
    "planning.controller": ("Controller",),
    "planning.meta.agent": ("AdaptiveAgent",),
    "planning.meta.function": ("FunctionModel",),
    "planning.optimizers": ("CEM", "ICEM", "MPPI", "RandomShooting"),
    "report.diagnosis": ("Diagnosis", "diagnose"),
    "report.dynamics": ("plot_dynamics",),
    "report.page.build": ("write_report",),
    "report.recording": ("Recording", "record"),
    "service": ("load",),
    "sim_params": ("SimParamSets",),
    "storage.run_dir": ("RunDir",),
    "storage.tables": ("EpisodeRow",),
    "tasks.base": ("Task",),
    "tasks.catalog": ("EnvSpec", "env_spec", "register"),
}
_WHERE = {name: module for module, names in _HOME.items() for name in names}

__all__ = ["__version__", *sorted(_WHERE)]  # noqa: PLE0604  # pyright: ignore[reportUnsupportedDunderAll]


def __getattr__(name: str):
    if name not in _WHERE:
        raise AttributeError(f"module 'headway' has no attribute {name!r}")
    return getattr(importlib.import_module(f"headway.{_WHERE[name]}"), name)


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
