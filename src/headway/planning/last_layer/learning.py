"""Corrections that an agent learns while it acts, and whether the physics has changed."""

from typing import TYPE_CHECKING, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from headway.planning.heads import RecentTransitions
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
    from headway.planning.agent import Agent

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
    def nothing(cls, agent: "Agent", num_envs: int) -> "Learned":
        """At the start of an episode."""
        layer = suspicion = None
        if agent.prior is not None and agent.planner.adaptation != "none":
            layer = untaught(agent, agent.prior, num_envs)
            if agent.planner.change_threshold:
                suspicion = jnp.zeros(num_envs)
        return cls(layer, suspicion)


def untaught(agent: "Agent", prior: Prior, num_envs: int) -> LastLayer:
    """The corrections before the first transition of an episode."""
    _, num_heads, head_size, obs_size = agent.model.forward_net.mean_heads.weight.shape
    return LastLayer.of_prior(prior, num_envs, (num_heads, head_size + 1, obs_size))


def learn(
    agent: "Agent",
    learned: Learned,
    recent: RecentTransitions,
    context: Context,
    happened: Bool[Array, " env"],
) -> Learned:
    """Learn from the newest transition of every environment.

    Args:
        agent: The agent.
        learned: What was learned before.
        recent: The newest transition is in the last slot.
        context: The context vectors that the heads plan with.
        happened: Where there was a transition.
    """
    if agent.prior is None or learned.layer is None:
        return learned
    newest = recent.obs[:, -1], recent.action[:, -1], recent.next_obs[:, -1]
    seen = Seen.through(agent.model, agent.task, agent.statistics, newest, context)
    observed = Observed.of(seen, happened)
    return Learned(*teach(agent, agent.prior, observed, learned.layer, learned.suspicion))


def teach(
    agent: "Agent",
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
        anew = untaught(agent, prior, len(suspicion))
        first = happened * log_likelihood(forecast(anew, observed), anew, prior)
        unexpected = surprise(first, likelihood)
        most = agent.planner.change_threshold / (CONFIRMATIONS - 0.5)
        suspicion = suspicion + jnp.minimum(unexpected, most)
        changed = suspicion > agent.planner.change_threshold
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
