"""What one update of a model reads."""

from typing import NamedTuple

from jaxtyping import Array, Float, Int

from headway.data import History


class Batch(NamedTuple):
    """Samples of every member; leading axes [member, sample]."""

    obs: Float[Array, "member sample obs"]
    action: Float[Array, "member sample action"]
    next_obs: Float[Array, "member sample obs"]
    history: History
    weight: Float[Array, "member sample"]
    """1 for a sample, 0 for padding."""
    sim_params: Float[Array, "member sample sim_param"] | None = None
    """The true simulator parameters, for a model that is told them."""
    trajectory: Int[Array, "member sample"] | None = None
    """Which trajectory each sample comes from."""
