"""The kinds of models that a run can train, behind one interface; `model.kind` chooses."""

from headway.config import BUILT_IN_KINDS, MODELS, Config, ModelConfig, OwnModelConfig
from headway.errors import ConfigError
from headway.experiment.learners.adaptive import GradientAdaptation, Recurrence
from headway.experiment.learners.base import Fit as Fit
from headway.experiment.learners.base import Learned as Learned
from headway.experiment.learners.base import Learner as Learner
from headway.experiment.learners.multi_headed import MultiHeaded
from headway.experiment.learners.untrained import Random, Simulator
from headway.task import Task

_LEARNERS: dict[str, type[Learner]] = {
    "multi-headed": MultiHeaded,
    "gradient-adapted": GradientAdaptation,
    "recurrent": Recurrence,
    "simulator": Simulator,
    "none": Random,
}


def register_learner(
    kind: str, learner: type[Learner], settings: type[ModelConfig] = OwnModelConfig
) -> None:
    """Add a kind of model of your own; `model.kind` then chooses it.

    A program that reads its runs must have registered it too. Runs of it cannot go side by side
    on Ray.

    Args:
        kind: Its name.
        learner: How it begins, is fitted and acts.
        settings: The class of its settings (`headway.config.settings`), whose first is `kind`.

    Raises:
        ConfigError: The name is a built-in one, or the class is no `Learner`.
    """
    if not kind or kind in BUILT_IN_KINDS:
        raise ConfigError(
            f"model kind {kind!r} is not free, allowed: any but {', '.join(BUILT_IN_KINDS)}."
        )
    if not (isinstance(learner, type) and issubclass(learner, Learner)):
        raise ConfigError(f"{learner!r} is no Learner, allowed: a class that inherits from it.")
    MODELS[kind] = settings
    _LEARNERS[kind] = learner


def make_learner(config: Config, task: Task, episode_length: int) -> Learner:
    """Build the learner that `model.kind` names.

    Args:
        config: Settings of the run.
        task: Its Task.
        episode_length: Steps of an episode.
    """
    return _LEARNERS[config.model.kind](config, task, episode_length)
