"""Trainers: how each kind of model begins, is fitted to episodes, and acts; `model.kind` chooses.

Adaptive baselines: learning_to_adapt, `meta_mlp_dynamics.py` (GrBAL) and `rnn_dynamics.py` (ReBAL).
"""

import warnings
from collections import defaultdict
from collections.abc import Callable, Iterable, Iterator, Sequence
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
    ModelConfig,
    OwnModelConfig,
    override,
)
from headway.data import Episodes, Samples, Trajectory
from headway.errors import ConfigError
from headway.models.base import Model
from headway.models.compilation import prepare_jax
from headway.models.fitting import (
    EpochStats,
    FitSetup,
    FitState,
    assign_segments,
    episode_losses,
    fit_epoch,
    make_data,
)
from headway.models.grbal import GrBAL, ReluNet, meta_epoch, tasks_per_update
from headway.models.last_layer_prior import fit_prior
from headway.models.multi_headed import MultiHeadModel, MultiHeadNet
from headway.models.rebal import ReBAL, RecurrentNet, episodes_per_update, recurrent_epoch
from headway.models.statistics import Statistics
from headway.planning.agent import Agent
from headway.task import episode_length, sim_param_sets, task_of
from headway.training.diagnostics import prediction_error
from headway.training.environments import Environments
from headway.training.methods import told_sim_params
from headway.training.run import Iteration, RunDir, format_sim_params

Epochs = Iterator[tuple[Any, EpochStats]]
"""State of training after each epoch, and the epoch's averages."""


class Trainer:
    """One kind of model, for one run; as it stands here nothing is learned and actions are random.

    The state of training is a pytree of arrays, and the content of a checkpoint.

    Args:
        config: Settings of the run.
        environments: Where it acts, if that is known; only the simulator asks.
    """

    def __init__(self, config: Config, environments: Environments | None = None):
        self.config, self.task, self.environments = config, task_of(config), environments

    def init(self, key: PRNGKeyArray) -> Any:
        """Draw the state that training begins with."""
        return ()

    def num_epochs(self, trajectories: Sequence[Trajectory]) -> int:
        """Passes over the data in one iteration: `fitting.epochs`, more where data are few.

        Args:
            trajectories: All data so far.
        """
        fitting = self.config.fitting
        return max(fitting.epochs, -(-fitting.min_updates // self.num_updates(trajectories)))

    def num_updates(self, trajectories: Sequence[Trajectory]) -> int:
        """Updates in one pass over the data."""
        return self.num_batches(trajectories)

    def num_batches(self, trajectories: Sequence[Trajectory]) -> int:
        """Batches in one pass over the data."""
        fitting = self.config.fitting
        offsets = range(fitting.future_length)
        samples = sum(max(0, len(one) - offset) for one in trajectories for offset in offsets)
        return -(-samples // fitting.batch_size)

    def fit(
        self,
        state: Any,
        trajectories: list[Trajectory],
        iteration: int,
        key: PRNGKeyArray,
        first: int = 0,
    ) -> Epochs:
        """Fit everything collected so far.

        Args:
            state: The state to go on from.
            trajectories: All data so far.
            iteration: The iteration of the run, from 0.
            key: It alone decides what is drawn.
            first: The first epoch; later than 0 where an interrupted fit goes on.
        """
        raise NotImplementedError

    def model(self, state: Any, trajectories: Sequence[Trajectory] = ()) -> Model | None:
        """The model that acts; None acts at random.

        Args:
            state: The state of training.
            trajectories: Data that it was fitted to; only heads that keep learning ask.
        """
        return None

    def agent(self, state: Any, trajectories: Sequence[Trajectory] = ()) -> Agent:
        """The agent that plans with the model."""
        return Agent(self.model(state, trajectories), self.task, self.config.planner)

    def head_losses(
        self, state: Any, trajectories: list[Trajectory]
    ) -> Iterable[Float[np.ndarray, "member head time"]]:
        """Loss of every head along each trajectory; none where there are no heads."""
        return ()

    def head_shares(self, state: Any, trajectories: list[Trajectory]) -> list[dict[str, Any]]:
        """Rows of `assignments.csv`, without the iteration; none where there are no heads."""
        return []

    def prediction_error(
        self, state: Any, trajectories: list[Trajectory], key: PRNGKeyArray
    ) -> Float[np.ndarray, " step"]:
        """Error by imagined step over some episodes; empty where nothing is learned.

        The model is taken as it was fitted: nothing of it learns while acting.
        """
        frozen = override(self.config, {"planner.adaptation": "none"})
        if not frozen.model.learns:
            return np.zeros(0)
        model = type(self)(frozen).model(state)
        assert model is not None
        # The same moments for every kind of model, whatever it remembers.
        first = max(frozen.model.history_length, frozen.planner.selection_length)
        return prediction_error(model, trajectories, first, frozen.planner.horizon, key)

    def begin(self) -> Any:
        """The state that the run's seed begins with."""
        return self.init(jax.random.fold_in(jax.random.key(self.config.seed), 0))

    def load(self, run: RunDir, iteration: Iteration = None) -> Any:
        """Read a checkpoint of a run, the newest by default.

        Raises:
            RunError: No such iteration is kept, or the checkpoint is damaged.
        """
        return run.load_checkpoint(eqx.filter_eval_shape(self.begin), iteration)


class TrainState(NamedTuple):
    """State of training of a network."""

    fit: FitState
    """Weights and the optimiser's moments."""
    statistics: Statistics
    """Normalisers of the data that they were fitted to."""


class Fitted(Trainer):
    """A network that is fitted epoch by epoch to the samples that T-MCL has."""

    def __init__(self, config: Config, environments: Environments | None = None):
        super().__init__(config, environments)
        self.history_length, self.names = config.model.history_length, told_sim_params(config)
        self.setup = FitSetup(self.task, config.fitting, self.history_length)
        self.learned_reward = config.model.learned_reward

    def begin_with(self, net: Any) -> TrainState:
        """A drawn network, with normalisers that change nothing yet."""
        sizes = self.task, self.history_length, self.names
        identity = Statistics.identity(*sizes, learned_reward=self.learned_reward)
        return TrainState(FitState.new(net), identity)

    def pad(self, trajectories: list[Trajectory]) -> Episodes:
        """Lay all data out, padded to their size at the end of the run: compiled once.

        With `collection.min_steps` nobody knows how many episodes there will be, nor how long;
        then sizes double when they must.
        """
        return self._padded(trajectories, *self._capacity(trajectories))

    def _capacity(self, trajectories: Sequence[Trajectory]) -> tuple[int, int]:
        """Episodes, and steps of each, that all data are padded to."""
        collection, length = self.config.collection, episode_length(self.config)
        capacity = max(collection.num_iterations * collection.num_episodes, len(trajectories))
        if collection.min_steps:
            longest = max(map(len, trajectories))
            length = min(length, max(64, 2 ** (longest - 1).bit_length()))
            capacity = max(capacity, 2 ** (len(trajectories) - 1).bit_length())
        return capacity, length

    def _padded(self, trajectories: list[Trajectory], capacity: int, length: int) -> Episodes:
        sizes = capacity, length, self.names
        return Episodes.pad(trajectories, *sizes, outcomes=self.learned_reward)

    def epoch(self, iteration: int, key: PRNGKeyArray) -> tuple[Callable, Any, Any]:
        """A pass over the data, and the keys of bootstrap samples and of shuffles.

        The pass is a function `(state, setup, data, *, key)` to the next state and its averages.
        """
        raise NotImplementedError

    def fit(self, state: TrainState, trajectories, iteration, key, first=0) -> Epochs:
        """Renew the normalisers, collate what an epoch reads, and go through it again and again."""
        one_epoch, data_key, epoch_key = self.epoch(iteration, key)
        model, fitting, fit = self.config.model, self.config.fitting, state.fit
        episodes, collection = self.pad(trajectories), self.config.collection
        # A round begins while steps are too few, so it may bring as many as it can once more.
        most = collection.num_episodes * episode_length(self.config) + collection.min_steps
        most = max(collection.num_iterations * most, sum(map(len, trajectories)))
        known = self.task, trajectories, self.history_length, self.names
        statistics = Statistics.fit(*known, learned_reward=self.learned_reward)
        samples = Samples.table(
            [len(trajectory) for trajectory in trajectories],
            fitting.future_length,
            capacity=most * fitting.future_length,
            drop_first=fitting.drop_first_anchor,
        )
        data = make_data(
            episodes, samples, statistics, fitting, num_members=model.num_members, key=data_key
        )
        for epoch in range(first, self.num_epochs(trajectories)):
            shuffle = jax.random.fold_in(epoch_key, epoch)
            fit, stats = one_epoch(fit, self.setup, data, key=shuffle)
            yield TrainState(fit, statistics), jax.device_get(stats)


class MultiHeadedTrainer(Fitted):
    """Ensembles of multi-headed networks: T-MCL and all that is expressed by its settings."""

    def init(self, key: PRNGKeyArray) -> TrainState:
        """See `Trainer.init`."""
        model = self.config.model
        net = MultiHeadNet.init(model, self.task, sim_param_names=self.names, key=key)
        return self.begin_with(net)

    def epoch(self, iteration, key):
        """See `Fitted.epoch`."""
        fitting = self.config.fitting
        independent = (
            iteration < fitting.warmup_iterations
            or fitting.oracle == "independent"
            or self.config.model.num_heads == 1
        )
        return partial(fit_epoch, independent=independent), *jax.random.split(key)

    def model(self, state: TrainState, trajectories: Sequence[Trajectory] = ()) -> MultiHeadModel:
        """See `Trainer.model`."""
        net, statistics, planner = state.fit.model, state.statistics, self.config.planner
        prior = None
        if planner.adaptation != "none":
            prior = fit_prior(
                net,
                self.task,
                statistics,
                trajectories,
                history_length=self.history_length,
                horizon=planner.horizon,
            )
        return MultiHeadModel(net, statistics, self.task, planner, self.history_length, prior)

    def head_losses(
        self, state: TrainState, trajectories: list[Trajectory]
    ) -> Iterable[Float[np.ndarray, "member head time"]]:
        """See `Trainer.head_losses`; one trajectory at a time."""
        for trajectory in trajectories:
            episode = self._padded([trajectory], 1, episode_length(self.config))
            losses = episode_losses(state.fit.model, self.setup, episode, 0, state.statistics)
            yield np.asarray(losses.forward)[..., : len(trajectory)]

    def head_shares(
        self, state: TrainState, trajectories: list[Trajectory]
    ) -> list[dict[str, Any]]:
        """Share of the segments of each physics whose best head is each head, by member."""
        net, setup, episodes = state.fit.model, self.setup, self.pad(trajectories)
        assigned = eqx.filter_jit(assign_segments)(net, setup, episodes, state.statistics)
        best = np.asarray(assigned.forward)
        counts = defaultdict(lambda: np.zeros((net.num_members, net.num_heads)))
        sets = sim_param_sets(self.config)
        for row, trajectory in enumerate(trajectories):
            used = -(-len(trajectory) // setup.segment_length)
            of_heads = best[:, row, :used, None] == np.arange(net.num_heads)
            counts[format_sim_params(sets.nearest(trajectory.sim_params))] += of_heads.sum(1)
        return [
            {"member": member, "head": head, "sim_params": physics, "share": float(share)}
            for physics, count in sorted(counts.items())
            for (member, head), share in np.ndenumerate(count / count.sum(-1, keepdims=True))
        ]


class GradientAdaptedTrainer(Fitted):
    """GrBAL: weights from which one gradient step adapts."""

    @property
    def inner_step(self) -> dict[str, Any]:
        """Transitions that a gradient step adapts to, and its size."""
        model: Any = self.config.model
        return {"length": model.adaptation_length, "rate": model.adaptation_rate}

    def init(self, key: PRNGKeyArray) -> TrainState:
        """See `Trainer.init`."""
        return self.begin_with(ReluNet.init(self.config.model, self.task, key=key))

    def num_updates(self, trajectories: Sequence[Trajectory]) -> int:
        """See `Trainer.num_updates`; `meta_epoch` fills its batches with whole tasks."""
        length = self.inner_step["length"]
        seen = 2 * length * tasks_per_update(self.config.fitting.batch_size, length)
        return max(1, sum(map(len, trajectories)) // seen)

    def epoch(self, iteration, key):
        """See `Fitted.epoch`."""
        return partial(meta_epoch, **self.inner_step), key, key

    def model(self, state: TrainState, trajectories: Sequence[Trajectory] = ()) -> GrBAL:
        """See `Trainer.model`."""
        return GrBAL(state.fit.model, state.statistics, self.task, **self.inner_step)


class RecurrentTrainer(Fitted):
    """ReBAL: a recurrent network."""

    def init(self, key: PRNGKeyArray) -> TrainState:
        """See `Trainer.init`."""
        return self.begin_with(RecurrentNet.init(self.config.model, self.task, key=key))

    def num_updates(self, trajectories: Sequence[Trajectory]) -> int:
        """See `Trainer.num_updates`; `recurrent_epoch` fills its batches with whole episodes."""
        _, length = self._capacity(trajectories)
        return -(-len(trajectories) // episodes_per_update(self.config.fitting.batch_size, length))

    def epoch(self, iteration, key):
        """See `Fitted.epoch`."""
        return recurrent_epoch, key, key

    def model(self, state: TrainState, trajectories: Sequence[Trajectory] = ()) -> ReBAL:
        """See `Trainer.model`."""
        return ReBAL(state.fit.model, state.statistics, self.task)


class SimulatorTrainer(Trainer):
    """The planner on the true dynamics."""

    def model(self, state: Any, trajectories: Sequence[Trajectory] = ()) -> Model:
        """See `Trainer.model`.

        Raises:
            ConfigError: No environments are given.
        """
        if self.environments is None:
            raise ConfigError(
                "a run on the true dynamics has no controller of its own, allowed: testing it in"
                " its simulator; use `headway evaluate`."
            )
        from headway.envs.built_in import ClassicVectorEnv
        from headway.models.simulator import ClassicSimulator, EnvSimulator

        vector = self.environments.vector
        if isinstance(vector, ClassicVectorEnv):
            return ClassicSimulator(vector, self.task)
        return EnvSimulator(vector, self.task)


TRAINERS: dict[str, type[Trainer]] = {
    "multi-headed": MultiHeadedTrainer,
    "gradient-adapted": GradientAdaptedTrainer,
    "recurrent": RecurrentTrainer,
    "simulator": SimulatorTrainer,
    "none": Trainer,
}


def register_model(
    kind: str, trainer: type[Trainer], settings: type[ModelConfig] = OwnModelConfig
) -> None:
    """Add a kind of model of your own; `model.kind` then chooses it.

    A program that reads its runs must have registered it too. Runs of it cannot go side by side
    on Ray.

    Args:
        kind: Its name.
        trainer: A subclass of `Trainer`.
        settings: The class of its settings (`headway.config.settings`), whose first is `kind`.

    Raises:
        ConfigError: The name is a built-in one, or the class is no `Trainer`.
    """
    if not kind or kind in BUILT_IN_KINDS:
        raise ConfigError(
            f"model kind {kind!r} is not free, allowed: any but {', '.join(BUILT_IN_KINDS)}."
        )
    if not (isinstance(trainer, type) and issubclass(trainer, Trainer)):
        raise ConfigError(f"{trainer!r} is no Trainer, allowed: a class that inherits from it.")
    MODELS[kind] = settings
    TRAINERS[kind] = trainer


def make_trainer(config: Config, environments: Environments | None = None) -> Trainer:
    """Build the trainer that `model.kind` names. Imports no simulator.

    Args:
        config: Settings of the run.
        environments: Where it will act; a run on the true dynamics cannot do without.
    """
    return TRAINERS[config.model.kind](config, environments)


def load_agent(
    run: RunDir,
    config: Config | None = None,
    environments: Environments | None = None,
    iteration: Iteration = None,
) -> Agent:
    """The agent of a run, as it was after an iteration; warns if its environment changed since.

    Args:
        run: The run.
        config: Its settings, with those of the planner perhaps changed; as it is by default.
        environments: As `make_trainer`.
        iteration: As `RunDir.kept_iteration`; the newest by default.

    Raises:
        RunError: There is no run, it does not keep the iteration, or it is damaged.
        ConfigError: It is a run on the true dynamics, and there are no environments.
    """
    prepare_jax()
    config = config or run.config()
    changed = run.environment_changes()
    if changed:
        warnings.warn(
            f"{run.path} was trained on {config.env} as it was before ({'; '.join(changed)}).",
            stacklevel=2,
        )
    trainer = make_trainer(config, environments)
    number = run.kept_iteration(iteration)
    state = trainer.load(run, number)
    trajectories = run.load_data(number) if config.planner.adaptation != "none" else []
    return trainer.agent(state, trajectories)
