"""A run's Task, its model as it begins, and as it was trained. Imports no simulator."""

import equinox as eqx
import jax

from headway.config import Config
from headway.planning.agent import Agent
from headway.task import Task, env_options, env_spec
from headway.training.collect import Environments
from headway.training.learners import Learned, make_learner
from headway.training.methods import check_options
from headway.training.run import RunDir


def load_task(config: Config) -> Task:
    """The Task of a configuration, with its environment's options."""
    check_options(config)
    return env_spec(config.env).make_task(**env_options(config))


def initial(config: Config, task: Task) -> Learned:
    """The untrained model that a seed begins with."""
    key = jax.random.fold_in(jax.random.key(config.seed), 0)
    return make_learner(config, task).initial(key)


def load_learned(run: RunDir, config: Config) -> Learned:
    """Read the newest checkpoint of a run.

    Raises:
        RunError: No iteration is finished yet, or the checkpoint is damaged.
    """
    task = load_task(config)
    return run.load_checkpoint(eqx.filter_eval_shape(lambda: initial(config, task)))


def load_agent(
    run: RunDir, config: Config | None = None, environments: Environments | None = None
) -> Agent:
    """The agent of a run, as trained so far.

    Args:
        run: The run.
        config: Its settings, with those of the planner perhaps changed; as it is by default.
        environments: Where it will act; a run on the true dynamics cannot do without.

    Raises:
        RunError: There is no run, it has no finished iteration, or it is damaged.
        ConfigError: It is a run on the true dynamics, and there are no environments.
    """
    config = config or run.config()
    learned = load_learned(run, config)
    trajectories = run.load_data() if config.planner.adaptation != "none" else []
    return make_learner(config, load_task(config)).agent(learned, environments, trajectories)
