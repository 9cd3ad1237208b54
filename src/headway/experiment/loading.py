"""What a configuration begins with, and what a run has learned so far."""

import equinox as eqx
import jax

from headway.config import Config
from headway.errors import RunError
from headway.experiment.learners import Learned, Learner, make_learner
from headway.experiment.limits import MemoryNeed, check_memory, memory_need
from headway.experiment.methods import check_options
from headway.experiment.rollouts import Arena
from headway.planning.acting import Acting
from headway.storage import arrays
from headway.storage.run_dir import RunDir
from headway.task import Task, env_options, env_spec, episode_length


def need_of(config: Config) -> MemoryNeed:
    """The memory that training a configuration needs."""
    return memory_need(config, load_task(config), episode_length(config))


def initial(config: Config, task: Task) -> Learned:
    """What a seed begins with, untrained."""
    key = jax.random.fold_in(jax.random.key(config.seed), 0)
    return learner_of(config, task).initial(key)


def learner_of(config: Config, task: Task) -> Learner:
    """The learner of a configuration."""
    return make_learner(config, task, episode_length(config))


def load_learned(run: RunDir, config: Config, *, ignore_limits: bool = False) -> Learned:
    """Read the newest checkpoint of a run.

    Args:
        run: The run.
        config: Its settings.
        ignore_limits: Try what seems too large for the free memory.

    Raises:
        LimitError: The model needs more memory than is free.
        RunError: No iteration is finished yet, or the checkpoint is damaged.
    """
    finished = finished_iterations(run)
    task = load_task(config)
    if not ignore_limits:
        check_memory(need_of(config).to_load)
    template = eqx.filter_eval_shape(lambda: initial(config, task))
    return arrays.load_tree(run.checked_checkpoint(finished - 1), template)


def finished_iterations(run: RunDir) -> int:
    """How many iterations of a run are finished; at least one.

    Raises:
        RunError: None is, or the run is damaged.
    """
    finished = run.finished_iterations
    if finished == 0:
        run.check()  # finds checkpoints without their manifests
        raise RunError(
            f"{run.path} has no finished iteration yet, because nothing is in manifests/; go on"
            " training it with the same `headway train` command, or complete the copy."
        )
    return finished


def load_agent(run: RunDir, config: Config | None = None, arena: Arena | None = None) -> Acting:
    """The agent of a run, as trained so far.

    Args:
        run: The run.
        config: Its settings, with those of the planner perhaps changed; as it is by default.
        arena: Where it will act; a run on the true dynamics cannot do without.

    Raises:
        RunError: There is no run, it has no finished iteration, or it is damaged.
        ConfigError: It is a run on the true dynamics, and there is no arena.
    """
    config = config or run.config()
    learned = load_learned(run, config)
    trajectories = run.load_data() if config.planner.adaptation != "none" else []
    return learner_of(config, load_task(config)).agent(learned, arena, trajectories)


def load_task(config: Config) -> Task:
    """The Task of a configuration, with its environment's options."""
    check_options(config)
    return env_spec(config.env).make_task(**env_options(config))
