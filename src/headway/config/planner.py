"""Settings of the planner."""

import dataclasses
import typing
from typing import Literal

from headway.config.model import Precision
from headway.problems import Problems

OptimizerName = Literal["cem", "icem", "mppi", "random-shooting"]
HeadSelection = Literal["adaptive", "average", "random"]
Adaptation = Literal["none", "last-layer"]


@dataclasses.dataclass(frozen=True)
class PlannerConfig:
    """How actions are chosen with the model (supplement A.2)."""

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
    precision: Precision = "float32"
    """What the networks multiply while planning; sums and states are always float32."""
    head_selection: HeadSelection = "adaptive"
    """Which head plans: the best on recent transitions, their average, or a random one."""
    selection_length: int = 10
    """Past transitions on which heads compete (N)."""
    selection_error: Literal["mean", "sampled"] = "mean"
    """Error of the predicted mean in normalised units, or (released code) of samples in raw
    units."""
    selection_skips_newest: bool = False
    """Whether the newest transition is not used to select heads (released code)."""
    reward: Literal["task", "released"] = "task"
    """The environment's own reward, or the one that the released code plans with."""
    adaptation: Adaptation = "none"
    """Whether heads keep learning while they act: `last-layer` corrects their means by Bayesian
    regression on the episode so far. Its prior comes from the training data."""
    change_threshold: float = 0.0
    """Log Bayes factor for changed physics above which the corrections are dropped; 0 never does
    (last-layer)."""

    def __post_init__(self):
        problems = Problems(self)
        problems.at_least(
            1, "horizon", "num_candidates", "num_elites", "num_iterations", "num_particles"
        )
        problems.at_least(1, "selection_length")
        problems.between(0.0, 1.0, "smoothing")
        problems.between(1e-6, 10.0, "initial_std")
        problems.between(0.0, 10.0, "noise_beta")
        problems.at_least(1, "population_decay")
        problems.between(0.0, 1.0, "kept_elite_fraction")
        problems.between(1e-6, 1e6, "temperature")
        problems.one_of("optimizer", typing.get_args(OptimizerName))
        problems.one_of("head_selection", typing.get_args(HeadSelection))
        problems.one_of("selection_error", ("mean", "sampled"))
        problems.one_of("reward", ("task", "released"))
        problems.one_of("particle_noise", ("independent", "shared"))
        problems.one_of("precision", typing.get_args(Precision))
        problems.one_of("adaptation", typing.get_args(Adaptation))
        problems.at_least(0, "change_threshold")
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
