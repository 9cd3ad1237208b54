"""Learners: how each kind of model begins, is fitted to episodes, and acts; `model.kind` chooses.

Adaptive baselines: learning_to_adapt, `meta_mlp_dynamics.py` (GrBAL) and `rnn_dynamics.py` (ReBAL).
"""

import abc
from collections import defaultdict
from collections.abc import Callable, Generator, Iterable, Sequence
from functools import partial
from typing import Any, NamedTuple

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Float, PRNGKeyArray

from headway.config import (
    BUILT_IN_KINDS,
    MODELS,
    Config,
    GradientAdaptedConfig,
    ModelConfig,
    OwnModelConfig,
    override,
)
from headway.data import Episodes, Samples, Trajectory
from headway.errors import ConfigError
from headway.models.acting import MultiHeadModel
from headway.models.fitting import (
    EpochStats,
    FitSetup,
    FitState,
    assign_segments,
    episode_losses,
    fit_epoch,
    make_data,
)
from headway.models.grbal import GrBAL, ReluNet, meta_epoch
from headway.models.last_layer_prior import fit_prior
from headway.models.multi_headed import MultiHeadDynamics, Statistics
from headway.models.rebal import ReBAL, RecurrentNet, recurrent_epoch
from headway.planning.agent import Agent
from headway.task import Task, episode_length
from headway.training.collect import Environments
from headway.training.diagnostics import prediction_error
from headway.training.methods import told_sim_params
from headway.training.run import format_sim_params


class Learned(NamedTuple):
    """Content of a checkpoint: pytrees of arrays."""

    fit: Any
    """Weights and the optimiser's moments, as an epoch takes and returns them."""
    statistics: Any
    """Normalisers of the data that they were fitted to."""


Epochs = Generator[tuple[Any, EpochStats], None, None]


class Fit(NamedTuple):
    """A fit to all data of an iteration, ready to run."""

    statistics: Any
    """The normalisers, renewed."""
    epochs: Callable[[Any, int], Epochs]
    """Goes on from a fit state with some epoch; yields the state after each, and its averages."""


class Learner(abc.ABC):
    """One kind of model, for one run.

    Args:
        config: Settings of the run.
        task: Its Task.
    """

    def __init__(self, config: Config, task: Task):
        self.config = config
        self.task = task

    @abc.abstractmethod
    def initial(self, key: PRNGKeyArray) -> Learned:
        """Draw what is not trained yet."""

    @abc.abstractmethod
    def fit(self, trajectories: list[Trajectory], iteration: int, key: PRNGKeyArray) -> Fit:
        """Prepare to fit everything collected so far; the key alone decides what is drawn."""

    @abc.abstractmethod
    def agent(
        self,
        learned: Learned,
        environments: Environments | None = None,
        trajectories: Sequence[Trajectory] = (),
    ) -> Agent:
        """The agent that acts with what was learned.

        Args:
            learned: What was learned.
            environments: Where it acts, if that is known; only the simulator asks.
            trajectories: What it was learned from; only heads that keep learning ask.
        """

    def head_losses(
        self, learned: Learned, trajectories: list[Trajectory]
    ) -> Iterable[Float[np.ndarray, "member head time"]]:
        """Loss of every head along each trajectory; none where there are no heads."""
        del learned, trajectories
        return ()

    def head_shares(
        self, learned: Learned, trajectories: list[Trajectory]
    ) -> Sequence[dict[str, Any]]:
        """Rows of `assignments.csv`, without the iteration; none where there are no heads."""
        del learned, trajectories
        return ()

    def prediction_error(
        self, learned: Learned, trajectories: list[Trajectory], key: PRNGKeyArray
    ) -> Float[np.ndarray, " step"]:
        """Error by imagined step over some episodes; empty where nothing is learned.

        The model is taken as it was fitted: nothing of it learns while acting.
        """
        config = override(self.config, {"planner.adaptation": "none"})
        if not config.model.learns:
            return np.zeros(0)
        agent = type(self)(config, self.task).agent(learned)
        # The same moments for every kind of model, whatever it remembers.
        first = max(config.model.history_length, config.planner.selection_length)
        return prediction_error(agent, trajectories, first=first, key=key)


class Fitted(Learner):
    """A network that is fitted epoch by epoch to the samples that T-MCL has."""

    @property
    def setup(self) -> FitSetup:
        """Constants of the compiled epoch."""
        return FitSetup(self.task, self.config.fitting, self.config.model.history_length)

    def begin(self, net: Any) -> Learned:
        """A drawn network, with normalisers that change nothing yet."""
        names, length = told_sim_params(self.config), self.config.model.history_length
        return Learned(FitState.new(net), Statistics.identity(self.task, length, names))

    def pad(self, trajectories: list[Trajectory]) -> Episodes:
        """Lay all data out, padded to their size at the end of the run: compiled once."""
        collection = self.config.collection
        of_run = collection.num_iterations * collection.num_episodes
        length, names = episode_length(self.config), told_sim_params(self.config)
        return Episodes.pad(trajectories, max(of_run, len(trajectories)), length, names)

    def fit_by(
        self,
        one_epoch: Callable[..., tuple[FitState, EpochStats]],
        trajectories: list[Trajectory],
        data_key: PRNGKeyArray,
        epoch_key: PRNGKeyArray,
    ) -> Fit:
        """Renew the normalisers and collate what an epoch reads.

        Args:
            one_epoch: Goes once through the data: `(state, setup, data, *, key)`.
            trajectories: All data so far.
            data_key: Draws the bootstrap samples.
            epoch_key: Shuffles every epoch.
        """
        model, fitting = self.config.model, self.config.fitting
        names, episodes = told_sim_params(self.config), self.pad(trajectories)
        statistics = Statistics.fit(self.task, trajectories, model.history_length, names)
        samples = Samples.table(
            [len(trajectory) for trajectory in trajectories],
            fitting.future_length,
            capacity=episodes.action[..., 0].size * fitting.future_length,
            drop_first=fitting.drop_first_anchor,
        )
        data = make_data(
            episodes, samples, statistics, fitting, num_members=model.num_members, key=data_key
        )

        def epochs(state: FitState, first: int) -> Epochs:
            for epoch in range(first, fitting.epochs):
                key = jax.random.fold_in(epoch_key, epoch)
                state, stats = one_epoch(state, self.setup, data, key=key)
                yield state, jax.device_get(stats)

        return Fit(statistics, epochs)


class MultiHeaded(Fitted):
    """Ensembles of multi-headed networks: T-MCL and all that is expressed by its settings."""

    def initial(self, key: PRNGKeyArray) -> Learned:
        """See `Learner.initial`."""
        names = told_sim_params(self.config)
        net = MultiHeadDynamics.init(self.config.model, self.task, sim_param_names=names, key=key)
        return self.begin(net)

    def fit(self, trajectories: list[Trajectory], iteration: int, key: PRNGKeyArray) -> Fit:
        """See `Learner.fit`."""
        fitting = self.config.fitting
        independent = (
            iteration < fitting.warmup_iterations
            or fitting.oracle == "independent"
            or self.config.model.num_heads == 1
        )
        one_epoch = partial(fit_epoch, independent=independent)
        return self.fit_by(one_epoch, trajectories, *jax.random.split(key))

    def agent(
        self,
        learned: Learned,
        environments: Environments | None = None,
        trajectories: Sequence[Trajectory] = (),
    ) -> Agent:
        """See `Learner.agent`."""
        del environments
        net, statistics = learned.fit.model, learned.statistics
        planner, length = self.config.planner, self.config.model.history_length
        prior = None
        if planner.adaptation != "none":
            prior = fit_prior(
                net,
                self.task,
                statistics,
                trajectories,
                history_length=length,
                horizon=planner.horizon,
            )
        model = MultiHeadModel(net, statistics, self.task, planner, length, prior)
        return Agent(model, self.task, planner)

    def head_losses(
        self, learned: Learned, trajectories: list[Trajectory]
    ) -> Iterable[Float[np.ndarray, "member head time"]]:
        """See `Learner.head_losses`; one trajectory at a time."""
        length, names = episode_length(self.config), told_sim_params(self.config)
        for trajectory in trajectories:
            episode = Episodes.pad([trajectory], 1, length, names)
            losses = episode_losses(learned.fit.model, self.setup, episode, 0, learned.statistics)
            yield np.asarray(losses.forward)[..., : len(trajectory)]

    def head_shares(
        self, learned: Learned, trajectories: list[Trajectory]
    ) -> Sequence[dict[str, Any]]:
        """Share of the segments of each physics whose best head is each head, by member."""
        net, setup, episodes = learned.fit.model, self.setup, self.pad(trajectories)
        assigned = eqx.filter_jit(assign_segments)(net, setup, episodes, learned.statistics)
        best = np.asarray(assigned.forward)
        counts = defaultdict(lambda: np.zeros((net.num_members, net.num_heads)))
        for row, trajectory in enumerate(trajectories):
            used = -(-len(trajectory) // setup.segment_length)
            for head in range(net.num_heads):
                of_head = (best[:, row, :used] == head).sum(-1)
                counts[format_sim_params(trajectory.sim_params)][:, head] += of_head
        return [
            {"member": member, "head": head, "sim_params": physics, "share": float(share)}
            for physics, count in sorted(counts.items())
            for (member, head), share in np.ndenumerate(count / count.sum(-1, keepdims=True))
        ]


class GradientAdaptation(Fitted):
    """GrBAL: weights from which one gradient step adapts."""

    @property
    def inner_step(self) -> dict[str, Any]:
        """Transitions that a gradient step adapts to, and its size."""
        model = self.config.model
        assert isinstance(model, GradientAdaptedConfig)
        return {"length": model.adaptation_length, "rate": model.adaptation_rate}

    def initial(self, key: PRNGKeyArray) -> Learned:
        """See `Learner.initial`."""
        return self.begin(ReluNet.init(self.config.model, self.task, key=key))

    def fit(self, trajectories: list[Trajectory], iteration: int, key: PRNGKeyArray) -> Fit:
        """See `Learner.fit`."""
        del iteration
        return self.fit_by(partial(meta_epoch, **self.inner_step), trajectories, key, key)

    def agent(
        self,
        learned: Learned,
        environments: Environments | None = None,
        trajectories: Sequence[Trajectory] = (),
    ) -> Agent:
        """See `Learner.agent`."""
        del environments, trajectories
        model = GrBAL(learned.fit.model, learned.statistics, self.task, **self.inner_step)
        return Agent(model, self.task, self.config.planner)


class Recurrence(Fitted):
    """ReBAL: a recurrent network."""

    def initial(self, key: PRNGKeyArray) -> Learned:
        """See `Learner.initial`."""
        return self.begin(RecurrentNet.init(self.config.model, self.task, key=key))

    def fit(self, trajectories: list[Trajectory], iteration: int, key: PRNGKeyArray) -> Fit:
        """See `Learner.fit`."""
        del iteration
        return self.fit_by(recurrent_epoch, trajectories, key, key)

    def agent(
        self,
        learned: Learned,
        environments: Environments | None = None,
        trajectories: Sequence[Trajectory] = (),
    ) -> Agent:
        """See `Learner.agent`."""
        del environments, trajectories
        model = ReBAL(learned.fit.model, learned.statistics, self.task)
        return Agent(model, self.task, self.config.planner)


class Random(Learner):
    """Uniform random actions; nothing is learned."""

    def initial(self, key: PRNGKeyArray) -> Learned:
        """See `Learner.initial`."""
        del key
        return Learned((), ())

    def fit(self, trajectories: list[Trajectory], iteration: int, key: PRNGKeyArray) -> Fit:
        """Fail: there is nothing to fit, and `learns` of the settings says so."""
        raise NotImplementedError

    def agent(
        self,
        learned: Learned,
        environments: Environments | None = None,
        trajectories: Sequence[Trajectory] = (),
    ) -> Agent:
        """See `Learner.agent`."""
        del learned, environments, trajectories
        return Agent(None, self.task, self.config.planner)


class Simulator(Random):
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


LEARNERS: dict[str, type[Learner]] = {
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
        learner: A subclass of `Learner`.
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
    LEARNERS[kind] = learner


def make_learner(config: Config, task: Task) -> Learner:
    """Build the learner that `model.kind` names."""
    return LEARNERS[config.model.kind](config, task)
