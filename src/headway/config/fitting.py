"""Settings of the fit."""

import dataclasses
import typing
from typing import Literal

from headway.config.model import Precision
from headway.problems import Problems

Oracle = Literal["independent", "transition", "trajectory"]


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
    precision: Precision = "float32"
    """What the networks multiply while fitting, forwards and backwards. Sums, weights and Adam are
    always float32, and so are the first layers of the networks that predict. bfloat16 is faster
    where the processor multiplies it; RIA cannot use it."""
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
        problems.at_least(1, "backprop_steps")
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
        problems.one_of("precision", typing.get_args(Precision))
        problems.one_of("reduction", ("head", "segment"))
        problems.report()
