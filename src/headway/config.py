"""Every setting of a run: frozen, typed, checked, and written to JSON as it is.

Defaults are the paper's (supplement A.2, A.3); where the paper is silent they follow the
released code. A setting is addressed as `section.name`, for example `planner.horizon`.
"""

import dataclasses
import typing
from collections.abc import Mapping
from typing import Any, Literal

from headway.errors import shown
from headway.problems import Problems
from headway.sim_params import SimParamSets

Oracle = Literal["independent", "transition", "trajectory"]
OptimizerName = Literal["cem", "icem", "mppi", "random-shooting"]
HeadSelection = Literal["adaptive", "average", "random", "evidence", "evidence-sampled"]
ModelKind = Literal["multi-headed", "gradient-adapted", "recurrent", "simulator", "none"]
ContextKind = Literal["learned", "history", "sim-params"]
ContextPlace = Literal["input", "last-hidden", "head"]
Adaptation = Literal["none", "last-layer"]

PLAIN: Mapping[str, Any] = {
    "num_members": 1,
    "num_heads": 1,
    "context_size": 0,
    "backward_net": False,
    "deterministic": True,
}
"""Settings of every kind of model that is no multi-headed ensemble."""


@dataclasses.dataclass(frozen=True)
class ModelConfig:
    """The dynamics model: by default an ensemble of multi-headed networks (supplement A.3)."""

    kind: ModelKind = "multi-headed"
    """What predicts: an ensemble of multi-headed networks; one network that a gradient step
    adapts to the newest transitions (GrBAL); a recurrent one (ReBAL); the simulator itself; or
    nothing, and actions are random. All but the first have one member, one head, no context and
    no variance."""
    num_members: int = 5
    """Networks in the ensemble."""
    num_heads: int = 3
    """Prediction heads of each network (H)."""
    hidden_sizes: tuple[int, ...] = (200, 200, 200, 200)
    """Widths of the backbone's hidden layers."""
    context: ContextKind = "learned"
    """What tells the networks of the hidden physics: `learned` is the context encoder's vector,
    `history` the encoder's input as it is, `sim-params` the true simulator parameters."""
    context_at: ContextPlace = "head"
    """Where the context joins: the networks' `input`, the `last-hidden` layer, or each `head`."""
    context_size: int = 10
    """Width of a `learned` context; 0 builds no context encoder, and the networks see none."""
    context_hidden_sizes: tuple[int, ...] = (256, 128, 64)
    """Widths of the context encoder's hidden layers."""
    history_length: int = 10
    """Past transitions that enter the context encoder (K)."""
    backward_net: bool = True
    """Whether a second network predicts backwards in time, to shape the context (A.4)."""
    deterministic: bool = False
    """Whether heads predict a mean only and are fitted to the squared error."""
    backward_deterministic: bool = False
    """Whether the backward net is deterministic even where the forward net is not (CaDM)."""
    relation_head: bool = False
    """Whether a linear layer learns to tell which contexts come from the same trajectory, and
    thereby shapes the context (RIA); wants one head and a `learned` context."""
    adaptation_length: int = 16
    """Newest transitions that a gradient step adapts to while acting; in training, also the
    transitions that follow and judge the step (gradient-adapted; GrBAL)."""
    adaptation_rate: float = 1e-3
    """Size of that step (gradient-adapted; GrBAL)."""

    @property
    def learns(self) -> bool:
        """Whether there is anything to fit; the simulator and random actions need no fit."""
        return self.kind not in ("simulator", "none")

    def __post_init__(self):
        problems = Problems(self)
        problems.at_least(1, "num_members", "num_heads", "history_length")
        problems.at_least(1, "adaptation_length")
        problems.between(1e-12, 1.0, "adaptation_rate")
        problems.at_least(0, "context_size")
        problems.sizes("hidden_sizes")
        problems.sizes("context_hidden_sizes")
        problems.one_of("kind", typing.get_args(ModelKind))
        if self.kind != "multi-headed":
            plain = {name: getattr(self, name) for name in PLAIN}
            problems.require(
                plain == PLAIN,
                f"kind {shown(self.kind)} has {plain}, allowed: {PLAIN}",
            )
        problems.one_of("context", typing.get_args(ContextKind))
        problems.one_of("context_at", typing.get_args(ContextPlace))
        if self.relation_head:
            learned = self.context == "learned" and self.context_size > 0
            problems.require(
                learned and self.num_heads == 1,
                f"relation_head with num_heads {self.num_heads}, context {shown(self.context)} and"
                f" context_size {self.context_size}, allowed: one head and a learned context",
            )
        problems.report()


@dataclasses.dataclass(frozen=True)
class FittingConfig:
    """How the model is fitted to the data after each collection (supplement A.2, A.4)."""

    oracle: Oracle = "trajectory"
    """How losses are reduced over heads once the warm-up is over."""
    segment_length: int = 10
    """Consecutive transitions that share a winning head (M); used by `trajectory`."""
    warmup_iterations: int = 3
    """First iterations, in which every head learns from all data independently."""
    epochs: int = 50
    """Passes over the data per iteration."""
    batch_size: int = 256
    """Samples per member and update. Gradient-adapted: transitions per update, half of them to
    adapt to. Recurrent: transitions per update, in whole episodes, at least one."""
    block_transitions: int = 200_000
    """Most transitions, padding counted, that are fitted as one block; larger data are gone
    through block by block, in bounded memory. The paper's data are one block."""
    learning_rate: float = 1e-3
    """Adam's step size."""
    future_length: int = 5
    """Transitions ahead that are predicted with one context (F; released code)."""
    backprop_steps: int = 100
    """Steps that the gradient flows back through time (recurrent; ReBAL)."""
    max_rollbacks: int = 3
    """How often in an iteration a diverging epoch is made again, each time with a quarter step."""
    backward_weight: float = 0.5
    """Weight of the backward net's loss (released code)."""
    logvar_bound_weight: float = 0.01
    """Pull of the learned variance bounds towards each other (PETS)."""
    weight_decay: float = 1.0
    """Factor on the released code's per-layer weight decay (2.5e-5 to 1e-4)."""
    context_weight_decay: bool = True
    """Whether the context encoder decays too; the released code forgets it."""
    reduction: Literal["head", "segment"] = "head"
    """Oracle loss: `head` averages within each head and sums over heads (released code);
    `segment` is the plain average (the paper's equation 2)."""
    bootstrap: bool = False
    """Whether each member draws its own samples with replacement (released code, not paper)."""
    relation_temperature: float = 0.6
    """Softness of the weights exp(-distance / temperature) with which contexts of different
    trajectories count as the same where they predict the same (RIA)."""
    relation_distance_weight: float = 1.0
    """Weight of the loss that pulls predictions with contexts of one trajectory together (RIA)."""
    relation_transitions: int = 0
    """Transitions of a batch on which all its contexts are compared; 0 takes the whole batch, as
    RIA does. The time of an update grows with it."""
    drop_first_anchor: bool = False
    """Whether the first anchor of every trajectory is left out (a defect of the released code)."""

    def __post_init__(self):
        problems = Problems(self)
        problems.at_least(1, "segment_length", "epochs", "batch_size", "future_length")
        problems.at_least(1, "block_transitions", "backprop_steps")
        problems.at_least(
            0,
            "warmup_iterations",
            "max_rollbacks",
            "backward_weight",
            "logvar_bound_weight",
            "weight_decay",
        )
        problems.between(1e-12, 1.0, "learning_rate")
        problems.between(1e-6, 1e6, "relation_temperature")
        problems.at_least(0, "relation_distance_weight", "relation_transitions")
        problems.one_of("oracle", typing.get_args(Oracle))
        problems.one_of("reduction", ("head", "segment"))
        problems.report()


@dataclasses.dataclass(frozen=True)
class PlannerConfig:
    """How actions are chosen with the model (supplement A.2; fact sheet C)."""

    optimizer: OptimizerName = "cem"
    """What searches for the best action sequence; settings below name those they matter to."""
    horizon: int = 30
    """Imagined steps."""
    num_candidates: int = 200
    """Action sequences drawn per optimizer iteration; in the first one with iCEM."""
    num_elites: int = 50
    """Best candidates that shape the next iteration (CEM; iCEM, whose paper takes 10)."""
    num_iterations: int = 5
    """Optimizer iterations per plan; random shooting draws new candidates in each."""
    smoothing: float = 0.1
    """Share of the old mean and spread that is kept at each iteration (CEM, iCEM)."""
    initial_std: float = 0.5
    """Standard deviation of the first candidates, actions being scaled to [-1, 1] (CEM, iCEM);
    of all candidates (MPPI)."""
    warm_variance: bool = False
    """Whether to start from the variance of the last plan, shifted by one step as its mean is
    (CEM)."""
    warm_min_std: float = 0.1
    """Least standard deviation to start from with `warm_variance` (CEM)."""
    settle_tolerance: float = 0.0
    """A search ends early where an iteration moved the mean by less than this, root mean square
    over the plan, actions being scaled to [-1, 1]; 0 never does (CEM)."""
    noise_beta: float = 2.0
    """Exponent of the noise's power spectrum over the horizon: 0 white, 1 pink, 2 red; smoother
    for slow systems (iCEM, MPPI)."""
    population_decay: float = 1.25
    """Factor by which each iteration draws fewer candidates, down to twice the elites (iCEM)."""
    kept_elite_fraction: float = 0.3
    """Share of the elites that competes again in the next iteration and at the next step (iCEM)."""
    temperature: float = 0.5
    """Softness of the weights exp(return / temperature), the returns of an iteration being
    standardised: less looks at the best candidates only (MPPI)."""
    num_particles: int = 20
    """Imagined rollouts per candidate; a multiple of `model.num_members`."""
    particle_noise: Literal["independent", "shared"] = "independent"
    """Whether every candidate draws its own noise, or all share that of their particles: faster,
    and candidates are compared under equal luck."""
    precision: Literal["float32", "bfloat16"] = "float32"
    """What the networks multiply while planning; sums and states are always float32."""
    devices: Literal["local", "all"] = "local"
    """Which devices share the candidates: those of this process, or of all processes that
    `jax.distributed` joins, which must then all act alike, step by step."""
    head_selection: HeadSelection = "adaptive"
    """Which head plans: the best on recent transitions, their average, or a random one; the most
    likely one given all transitions, of which those older than `selection_length` hardly count
    (`evidence`), or one drawn by each member with that probability (`evidence-sampled`)."""
    selection_length: int = 10
    """Past transitions on which heads compete (N)."""
    selection_error: Literal["mean", "sampled", "corrected"] = "mean"
    """Error of the predicted mean in normalised units, or (released code) of samples in raw
    units; or of the mean with what the head has learned in the episode (last-layer)."""
    selection_skips_newest: bool = False
    """Whether the newest transition is not used to select heads (released code)."""
    reward: Literal["task", "released"] = "task"
    """The environment's own reward, or the one that the released code plans with."""
    adaptation: Adaptation = "none"
    """Whether heads keep learning while they act: `last-layer` corrects their means by Bayesian
    regression on the episode so far. Its prior comes from the training data."""
    adaptation_noise: Literal["constant", "heads"] = "constant"
    """Noise of the transitions that are learned from: the same for all, or in proportion to what
    each head's own variance says (last-layer)."""
    adaptation_prior: Literal["owner", "runner-up"] = "owner"
    """Which head's residuals on the training episodes the prior is fitted to: those of the head
    that explains an episode best, or second best, as if it were of unseen physics (last-layer)."""
    adaptation_variance: bool = False
    """Whether the uncertainty of what was learned adds to the noise of imagined steps (last-layer);
    costs one more hidden layer."""
    forgetting: float = 0.0
    """Share of the uncertainty before the episode that comes back at every step, so that old
    transitions count less; 0 never forgets (last-layer)."""
    change_threshold: float = 0.0
    """Log Bayes factor for changed physics above which all that was learned is dropped; 0 never
    does (last-layer)."""
    risk_aversion: float = 0.0
    """Candidates are ranked by the mean return minus this many standard deviations over their
    particles."""

    def __post_init__(self):
        problems = Problems(self)
        problems.at_least(
            1, "horizon", "num_candidates", "num_elites", "num_iterations", "num_particles"
        )
        problems.at_least(1, "selection_length")
        problems.between(0.0, 1.0, "smoothing")
        problems.between(1e-6, 10.0, "initial_std", "warm_min_std")
        problems.at_least(0, "settle_tolerance")
        problems.between(0.0, 10.0, "noise_beta")
        problems.at_least(1, "population_decay")
        problems.between(0.0, 1.0, "kept_elite_fraction")
        problems.between(1e-6, 1e6, "temperature")
        problems.one_of("optimizer", typing.get_args(OptimizerName))
        problems.one_of("head_selection", typing.get_args(HeadSelection))
        problems.one_of("selection_error", ("mean", "sampled", "corrected"))
        problems.one_of("reward", ("task", "released"))
        problems.one_of("particle_noise", ("independent", "shared"))
        problems.one_of("precision", ("float32", "bfloat16"))
        problems.one_of("devices", ("local", "all"))
        problems.one_of("adaptation", typing.get_args(Adaptation))
        problems.one_of("adaptation_noise", ("constant", "heads"))
        problems.one_of("adaptation_prior", ("owner", "runner-up"))
        problems.between(0.0, 0.99, "forgetting")
        problems.at_least(0, "change_threshold", "risk_aversion")
        share = {"icem": 2, "mppi": 0, "random-shooting": 0}.get(self.optimizer, 1)
        problems.require(
            share * self.num_elites <= self.num_candidates,
            f"num_elites is {self.num_elites}, allowed: at most {'half of ' * (share == 2)}"
            f"num_candidates ({self.num_candidates})",
        )
        problems.require(
            not (self.selection_skips_newest and self.selection_length == 1),
            "selection_skips_newest leaves nothing of a selection_length of 1, allowed: 2 or more",
        )
        problems.report()


@dataclasses.dataclass(frozen=True)
class CollectionConfig:
    """How much data is collected (supplement A.2)."""

    num_iterations: int = 10
    """Rounds of collecting and fitting; the first one acts at random."""
    num_episodes: int = 10
    """Episodes per iteration, all stepped and planned together."""
    episode_length: int = 0
    """Steps per episode; 0 takes the environment's own."""
    max_bad_episodes: int = 1
    """Most episodes of an iteration that are dropped because they broke: a number was not finite,
    a simulation diverged, a process hung or died."""
    env_processes: bool = False
    """Whether every environment runs in a process of its own, also in tests, so that one that
    hangs or crashes costs its episode only; slower where steps are quick."""
    step_timeout_s: float = 60.0
    """Seconds that a step or reset may take before its process is given up (env_processes)."""

    def __post_init__(self):
        problems = Problems(self)
        problems.at_least(1, "num_iterations", "num_episodes")
        problems.at_least(0, "episode_length", "max_bad_episodes")
        problems.between(1e-3, 1e6, "step_timeout_s")
        problems.report()


@dataclasses.dataclass(frozen=True)
class EvaluationConfig:
    """How controllers are tested; test episodes have fixed seeds, the same for every method."""

    every: int = 1
    """Iterations between tests on the unseen groups; the last iteration is always tested."""
    num_episodes: int = 10
    """Episodes per group, spread evenly over the group's simulator parameters."""
    training_group: Literal["last", "always"] = "last"
    """When the training physics are tested too: after the last iteration, or at every test."""
    seed: int = 10_000
    """Seed of the first test episode; the others follow it."""
    max_bad_episodes: int = 0
    """Most test episodes of an iteration that are left out because they broke; what is left may
    look better than it is."""

    def __post_init__(self):
        problems = Problems(self)
        problems.at_least(1, "every")
        problems.at_least(0, "max_bad_episodes")
        problems.between(1, 1000, "num_episodes")
        problems.between(0, 2**30, "seed")
        problems.one_of("training_group", ("last", "always"))
        problems.report()


@dataclasses.dataclass(frozen=True)
class Config:
    """Everything that decides a run's numbers."""

    env: str
    """Short name of the environment."""
    method: str = "tmcl"
    """Name of the method the settings started from."""
    preset: str = "paper"
    """Name of the preset the settings started from."""
    seed: int = 0
    """Seeds environments, physics, initial weights, batches and planner."""
    env_options: Mapping[str, bool] = dataclasses.field(default_factory=dict)
    """Switches of the environment that differ from its defaults."""
    sim_params: SimParamSets | None = None
    """Training and unseen simulator parameters; None takes the environment's own."""
    model: ModelConfig = dataclasses.field(default_factory=ModelConfig)
    """The dynamics model."""
    fitting: FittingConfig = dataclasses.field(default_factory=FittingConfig)
    """Fitting the model."""
    planner: PlannerConfig = dataclasses.field(default_factory=PlannerConfig)
    """Planning with the model."""
    collection: CollectionConfig = dataclasses.field(default_factory=CollectionConfig)
    """Collecting data."""
    evaluation: EvaluationConfig = dataclasses.field(default_factory=EvaluationConfig)
    """Testing."""

    def __post_init__(self):
        problems = Problems(self)
        problems.between(0, 2**31 - 1, "seed")
        problems.require(
            self.planner.num_particles % self.model.num_members == 0,
            f"planner.num_particles is {self.planner.num_particles}, allowed: a multiple of"
            f" model.num_members ({self.model.num_members})",
        )
        problems.require(
            self.model.kind != "simulator" or self.planner.num_particles == 1,
            f"planner.num_particles is {self.planner.num_particles}, allowed: 1, because the"
            " simulator has no noise",
        )
        problems.require(
            self.model.kind != "simulator" or self.planner.reward == "task",
            f"planner.reward is {shown(self.planner.reward)}, allowed: task, which the simulator"
            " pays",
        )
        problems.require(
            self.model.kind != "simulator" or not self.collection.env_processes,
            "collection.env_processes is True, allowed: False with plans on the simulator itself",
        )
        problems.report()
