"""Settings of the dynamics model."""

import dataclasses
import typing
from collections.abc import Mapping
from typing import Any, Literal

from headway.errors import shown
from headway.problems import Problems

ModelKind = Literal["multi-headed", "gradient-adapted", "recurrent", "simulator", "none"]
BUILT_IN_KINDS: tuple[str, ...] = typing.get_args(ModelKind)
OWN_KINDS: set[str] = set()
"""Kinds that were registered (`headway.register_learner`)."""
ContextKind = Literal["learned", "history", "sim-params"]
ContextPlace = Literal["input", "last-hidden", "head"]
Precision = Literal["float32", "bfloat16"]

PLAIN: Mapping[str, Any] = {
    "num_members": 1,
    "num_heads": 1,
    "context": "learned",
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
    nothing, and actions are random. All of these but the first have one member, one head, no
    context and no variance. Or one of your own (`headway.register_learner`)."""
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
        problems.one_of("kind", (*BUILT_IN_KINDS, *sorted(OWN_KINDS)))
        if self.kind in BUILT_IN_KINDS and self.kind != "multi-headed":
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
