"""What learns nothing: random actions, and planning on the simulator itself."""

from collections.abc import Sequence

from jaxtyping import PRNGKeyArray

from headway.data import Trajectory
from headway.errors import ConfigError
from headway.experiment.learners.base import Fit, Learned, Learner
from headway.planning.agent import Agent
from headway.training.collect import Environments


class Untrained(Learner):
    """A controller whose run is only a test."""

    learns = False

    def initial(self, key: PRNGKeyArray) -> Learned:
        """See `Learner.initial`."""
        del key
        return Learned((), ())

    def fit(self, trajectories: list[Trajectory], iteration: int, key: PRNGKeyArray) -> Fit:
        """There is nothing to fit.

        Raises:
            NotImplementedError: Always; nobody should ask.
        """
        raise NotImplementedError


class Random(Untrained):
    """Uniform random actions."""

    def agent(
        self,
        learned: Learned,
        environments: Environments | None = None,
        trajectories: Sequence[Trajectory] = (),
    ) -> Agent:
        """See `Learner.agent`."""
        del learned, environments, trajectories
        return Agent(None, self.task, self.config.planner)


class Simulator(Untrained):
    """The planner on the true dynamics."""

    def agent(
        self,
        learned: Learned,
        environments: Environments | None = None,
        trajectories: Sequence[Trajectory] = (),
    ) -> Agent:
        """See `Learner.agent`.

        Raises:
            ConfigError: No environments are given, or their simulator cannot be planned with.
        """
        del learned, trajectories
        if environments is None:
            raise ConfigError(
                "a run on the true dynamics has no controller of its own, allowed: testing it in"
                " its simulator; use `headway evaluate`."
            )
        from headway.envs.built_in import ClassicVectorEnv, RobotVectorEnv
        from headway.envs.futures import RobotFutures
        from headway.models.simulator import ClassicSimulator, RobotSimulator

        if isinstance(environments.vector, ClassicVectorEnv):
            model = ClassicSimulator(environments.vector, self.task)
        elif isinstance(environments.vector, RobotVectorEnv):
            model = RobotSimulator(RobotFutures(environments.vector), self.task)
        else:
            raise ConfigError(
                f"{self.config.env} has no simulator to plan with, allowed: the built-in"
                " environments; choose another method than true-dynamics."
            )
        return Agent(model, self.task, self.config.planner)
