# Public names and their modules, the only list of them; `__init__.py` loads each at its first use.

from .api import Run as Run
from .api import fit as fit
from .api import load as load
from .api import train as train
from .config import Config as Config
from .data import Trajectory as Trajectory
from .errors import BadEnvironmentError as BadEnvironmentError
from .errors import BrokenEpisodeError as BrokenEpisodeError
from .errors import BusyError as BusyError
from .errors import ConfigError as ConfigError
from .errors import DivergenceError as DivergenceError
from .errors import HeadwayError as HeadwayError
from .errors import LimitError as LimitError
from .errors import PlanningError as PlanningError
from .errors import RunError as RunError
from .errors import UnknownNameError as UnknownNameError
from .lab.diagnose import Diagnosis as Diagnosis
from .lab.diagnose import diagnose as diagnose
from .lab.dynamics import plot_dynamics as plot_dynamics
from .lab.record import Recording as Recording
from .lab.record import record as record
from .lab.report import write_report as write_report
from .models.base import FunctionModel as FunctionModel
from .models.fitting import EpochStats as EpochStats
from .models.multi_headed import MultiHeadNet as MultiHeadNet
from .planning.agent import Agent as Agent
from .planning.controller import Controller as Controller
from .planning.optimizers import CEM as CEM
from .planning.optimizers import ICEM as ICEM
from .planning.optimizers import MPPI as MPPI
from .planning.optimizers import RandomShooting as RandomShooting
from .sim_params import SimParamSets as SimParamSets
from .sim_params import Uniform as Uniform
from .task import EnvSpec as EnvSpec
from .task import Task as Task
from .task import env_spec as env_spec
from .task import register as register
from .training.check import Finding as Finding
from .training.check import check as check
from .training.evaluate import Evaluation as Evaluation
from .training.evaluate import evaluate as evaluate
from .training.methods import METHODS as METHODS
from .training.methods import PRESETS as PRESETS
from .training.methods import Method as Method
from .training.methods import make_config as make_config
from .training.methods import register_method as register_method
from .training.recordings import export_data as export_data
from .training.run import EpisodeRow as EpisodeRow
from .training.run import RunDir as RunDir
from .training.trainers import Trainer as Trainer
from .training.trainers import register_model as register_model

__all__: list[str]
__version__: str
