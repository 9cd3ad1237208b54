"""Corrections that an agent learns while it acts, and whether the physics has changed."""

from typing import TYPE_CHECKING, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from headway.models.base import Transition
from headway.planning.last_layer.regression import (
    LastLayer,
    Observed,
    Prior,
    Seen,
    credence,
    forecast,
    log_likelihood,
    update,
)
from headway.planning.optimizers import where_env

if TYPE_CHECKING:
    from headway.planning.heads import MultiHeadModel

Context = Float[Array, "member env context"] | None

CONFIRMATIONS = 3
"""Surprises, at least, that it takes to believe in changed physics: one or two may be contacts or
faults of a sensor."""


class Learned(NamedTuple):
    """What was learned in the episode of each environment; None where nothing of it is wanted."""

    layer: LastLayer | None = None
    """The corrections of the heads."""
    suspicion: Float[Array, " env"] | None = None
    """Evidence that the physics has changed, as a log Bayes factor; never below 0."""

    @classmethod
    def nothing(cls, model: "MultiHeadModel", num_envs: int) -> "Learned":
        """At the start of an episode."""
        layer = suspicion = None
        if model.prior is not None and model.planner.adaptation != "none":
            layer = untaught(model, model.prior, num_envs)
            if model.planner.change_threshold:
                suspicion = jnp.zeros(num_envs)
        return cls(layer, suspicion)


def untaught(model: "MultiHeadModel", prior: Prior, num_envs: int) -> LastLayer:
    """The corrections before the first transition of an episode."""
    _, num_heads, head_size, obs_size = model.net.forward_net.mean_heads.weight.shape
    return LastLayer.of_prior(prior, num_envs, (num_heads, head_size + 1, obs_size))


def learn(
    model: "MultiHeadModel",
    learned: Learned,
    transition: Transition,
    context: Context,
) -> Learned:
    """Learn from the newest transition of every environment.

    Args:
        model: The networks, their prior, and when the physics count as changed.
        learned: What was learned before.
        transition: What was observed.
        context: The context vectors that the heads plan with.
    """
    if model.prior is None or learned.layer is None:
        return learned
    seen = Seen.through(model.net, model.task, model.statistics, transition[:3], context)
    observed = Observed.of(seen, transition.happened)
    return Learned(*teach(model, model.prior, observed, learned.layer, learned.suspicion))


def teach(
    model: "MultiHeadModel",
    prior: Prior,
    observed: Observed,
    layer: LastLayer,
    suspicion: Float[Array, " env"] | None,
) -> tuple[LastLayer, Float[Array, " env"] | None]:
    """Correct the heads by one transition; what was learned may be dropped before.

    A very surprising transition counts the less, the more it surprises. If others confirm it,
    the physics has changed and what was learned is dropped.

    Returns:
        The corrections, and the suspicion that the physics has changed.
    """
    expected = forecast(layer, observed)
    if suspicion is not None:
        happened = observed.learned_from[..., None]
        likelihood = happened * log_likelihood(expected, layer, prior)
        anew = untaught(model, prior, len(suspicion))
        first = happened * log_likelihood(forecast(anew, observed), anew, prior)
        unexpected = surprise(first, likelihood)
        most = model.planner.change_threshold / (CONFIRMATIONS - 0.5)
        suspicion = suspicion + jnp.minimum(unexpected, most)
        changed = suspicion > model.planner.change_threshold
        suspicion = jnp.where(changed, 0.0, jnp.maximum(suspicion, 0.0))
        layer = where_env(changed, anew, layer)
        expected = forecast(layer, observed)
        doubtful = ((unexpected > most) & ~changed)[:, None, None]
        spread = expected.spread / credence(expected, layer, prior)
        observed = observed.noisier(jnp.where(doubtful, spread - expected.spread, 0.0))
        expected = forecast(layer, observed)
    return update(layer, observed, expected), suspicion


def surprise(
    anew: Float[Array, "env member head"], learned: Float[Array, "env member head"]
) -> Float[Array, " env"]:
    """How much better a transition is explained by an episode that has only begun.

    The log Bayes factor of heads that know nothing yet against those that have learned, heads
    being equally likely, on average over members.

    Args:
        anew: Log-likelihood of the transition under heads that know nothing yet.
        learned: The same under those that have learned.
    """
    both = [jax.scipy.special.logsumexp(x, axis=-1) for x in (anew, learned)]
    return (both[0] - both[1]).mean(-1)
