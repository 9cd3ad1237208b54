"""The kinds of models that a run can train, behind one interface; `model.kind` chooses."""

from headway.config import Config
from headway.experiment.learners.adaptive import GradientAdaptation, Recurrence
from headway.experiment.learners.base import Fit as Fit
from headway.experiment.learners.base import Learned as Learned
from headway.experiment.learners.base import Learner as Learner
from headway.experiment.learners.multi_headed import MultiHeaded
from headway.experiment.learners.untrained import Random, Simulator
from headway.tasks.base import Task

_LEARNERS: dict[str, type[Learner]] = {
    "multi-headed": MultiHeaded,
    "gradient-adapted": GradientAdaptation,
    "recurrent": Recurrence,
    "simulator": Simulator,
    "none": Random,
}


def make_learner(config: Config, task: Task, episode_length: int) -> Learner:
    """Build the learner that `model.kind` names.

    Args:
        config: Settings of the run.
        task: Its Task.
        episode_length: Steps of an episode.
    """
    return _LEARNERS[config.model.kind](config, task, episode_length)
