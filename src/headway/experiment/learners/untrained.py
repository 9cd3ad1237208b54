"""What learns nothing: random actions, and planning on the simulator itself."""

from collections.abc import Sequence

from jaxtyping import PRNGKeyArray

from headway.data import Trajectory
from headway.errors import ConfigError
from headway.experiment.learners.base import Fit, Learned, Learner
from headway.planning.acting import Acting, RandomAgent
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
    ) -> Acting:
        """See `Learner.agent`."""
        del learned, environments, trajectories
        return RandomAgent(self.task)


class Simulator(Untrained):
    """The planner on the true dynamics."""

    def agent(
        self,
        learned: Learned,
        environments: Environments | None = None,
        trajectories: Sequence[Trajectory] = (),
    ) -> Acting:
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
        from headway.experiment.true_dynamics import SimulatorAgent, make_simulator

        return SimulatorAgent(
            make_simulator(environments, self.config.planner), self.config.planner
        )
