"""What an agent learns while it acts: corrections of its heads, and how much to trust each head."""

from typing import TYPE_CHECKING, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray

from headway.models.products import PRECISIONS
from headway.planning.heads import RecentTransitions
from headway.planning.imagination import Doubt, Layer
from headway.planning.last_layer.regression import (
    LastLayer,
    Observed,
    Prior,
    Seen,
    credence,
    forecast,
    forget,
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
    log_evidence: Float[Array, "env member head"] | None = None
    """Log-likelihood of the recent transitions under each head, older ones counting less."""
    suspicion: Float[Array, " env"] | None = None
    """Evidence that the physics has changed, as a log Bayes factor; never below 0."""

    @classmethod
    def nothing(cls, agent: "Agent", num_envs: int) -> "Learned":
        """At the start of an episode."""
        layer = log_evidence = suspicion = None
        if agent.prior is not None and agent.planner.adaptation != "none":
            layer = untaught(agent, agent.prior, num_envs)
            if agent.planner.change_threshold:
                suspicion = jnp.zeros(num_envs)
        if by_evidence(agent):
            shape = num_envs, agent.model.num_members, agent.model.num_heads
            log_evidence = jnp.zeros(shape)
        return cls(layer, log_evidence, suspicion)


def untaught(agent: "Agent", prior: Prior, num_envs: int) -> LastLayer:
    """The corrections before the first transition of an episode."""
    _, num_heads, head_size, obs_size = agent.model.forward_net.mean_heads.weight.shape
    groups = num_heads if agent.planner.adaptation_noise == "heads" else 1
    sizes = num_heads, head_size + 1, obs_size
    return LastLayer.of_prior(prior, num_envs, sizes, groups=groups)


def by_evidence(agent: "Agent") -> bool:
    """Whether heads are chosen by the likelihood of what they predicted."""
    return agent.planner.head_selection in ("evidence", "evidence-sampled")


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
    if learned.layer is None and learned.log_evidence is None:
        return learned
    newest = recent.obs[:, -1], recent.action[:, -1], recent.next_obs[:, -1]
    seen = Seen.through(agent.model, agent.task, agent.statistics, newest, context)
    reference = None
    if agent.prior is not None and agent.planner.adaptation_noise == "heads":
        reference = agent.prior.log_reference
    observed = Observed.of(seen, happened, reference)
    if agent.prior is None or learned.layer is None:
        told = own_log_likelihood(observed.residual, seen.logvar)
    else:
        layer, suspicion, told = teach(
            agent, agent.prior, observed, learned.layer, learned.suspicion
        )
        learned = learned._replace(layer=layer, suspicion=suspicion)
    if learned.log_evidence is None:
        return learned
    kept = (1.0 - 1.0 / agent.planner.selection_length) * learned.log_evidence
    counts = (observed.learned_from[..., None] > 0) & jnp.isfinite(told)
    return learned._replace(log_evidence=jnp.where(counts, kept + told, learned.log_evidence))


def teach(
    agent: "Agent",
    prior: Prior,
    observed: Observed,
    layer: LastLayer,
    suspicion: Float[Array, " env"] | None,
) -> tuple[LastLayer, Float[Array, " env"] | None, Float[Array, "env member head"]]:
    """Correct the heads by one transition; what was learned may be forgotten or dropped before.

    A very surprising transition counts the less, the more it surprises. If others confirm it,
    the physics has changed and what was learned is dropped.

    Returns:
        The corrections, the suspicion that the physics has changed, and the log-likelihood of
        the transition before it was learned from.
    """
    if agent.planner.forgetting:
        layer = forget(layer, prior, agent.planner.forgetting)
    expected = forecast(layer, observed)
    happened = observed.learned_from[..., None]
    likelihood = happened * log_likelihood(expected, layer, prior)
    if suspicion is not None:
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
    return update(layer, observed, expected), suspicion, likelihood


def own_log_likelihood(
    residual: Float[Array, "env member head obs"],
    logvar: Float[Array, "env member head obs"] | None,
) -> Float[Array, "env member head"]:
    """Log-density of a transition under each head as it was trained, without constants.

    Deterministic heads, which have no `logvar`, count as having a variance of 1.
    """
    if logvar is None:
        return -0.5 * jnp.square(residual).sum(-1)
    return -0.5 * (jnp.square(residual) * jnp.exp(-logvar) + logvar).sum(-1)


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


def heads_by_evidence(
    agent: "Agent",
    log_evidence: Float[Array, "env member head"],
    *,
    key: PRNGKeyArray,
) -> Int[Array, "env member"]:
    """The head of the most evidence, or one drawn with its posterior probability.

    Every member draws for itself, so with `evidence-sampled` the particles are spread over heads
    by weight. Without any evidence the head is random.
    """
    drawn = jax.random.categorical(key, log_evidence, axis=-1)
    if agent.planner.head_selection == "evidence-sampled":
        return drawn
    told = (log_evidence != 0.0).any(-1)
    return jnp.where(told, log_evidence.argmax(-1), drawn)


def corrected_errors(
    agent: "Agent", layer: LastLayer, recent: RecentTransitions, context: Context
) -> Float[Array, "env member head slot"]:
    """`heads.head_errors` of the heads with their corrections, in normalised units."""
    num_envs, num_slots = recent.obs.shape[:2]
    rows = [x.reshape(num_envs * num_slots, -1) for x in recent[:3]]
    if context is not None:
        context = jnp.repeat(context, num_slots, axis=1)
    seen = Seen.through(
        agent.model, agent.task, agent.statistics, (rows[0], rows[1], rows[2]), context
    )
    features = seen.features.reshape(num_envs, num_slots, *seen.features.shape[1:])
    residual = seen.residual.reshape(num_envs, num_slots, *seen.residual.shape[1:])
    foreseen = jnp.einsum("esmi,emhio->esmho", features, layer.weight)
    return jnp.square(residual - foreseen).mean(-1).transpose(0, 2, 3, 1)


def doubt(
    agent: "Agent",
    layer: LastLayer,
    heads: Int[Array, "env member choice"],
    context: Context,
) -> Doubt | None:
    """How uncertain the corrections of the chosen heads are; None if plans need not know.

    Several heads are averaged, and what they learned is independent given the features: the
    variances add up, over the square of their number. They share the mean of their noises.
    """
    if not agent.planner.adaptation_variance or agent.prior is None:
        return None
    choices = heads.shape[-1]
    distinct = choices if layer.root.shape[2] > 1 else 1  # else all heads have the same root
    roots = [root_of(layer, heads[..., choice]) for choice in range(distinct)]
    root = jnp.concatenate(roots, axis=-1) / (choices * distinct) ** 0.5
    rest = jnp.ones((*root.shape[:2], 1))
    if context is not None and agent.model.forward_net.context_layer is None:
        rest = jnp.concatenate([context.transpose(1, 0, 2), rest], axis=-1)
    hidden = root.shape[-2] - rest.shape[-1]
    bias = jnp.einsum("emij,emi->emj", root[..., hidden:, :], rest)
    noise = [noise_of(layer, agent.prior, heads[..., choice]) for choice in range(choices)]
    scale = jnp.sqrt(sum(noise) / choices) * agent.statistics.delta.std
    precision = PRECISIONS[agent.planner.precision]
    weight = root[..., :hidden, :].mT.astype(precision)
    return Doubt(Layer(weight, bias), scale)


def root_of(
    layer: LastLayer, head: Int[Array, "env member"]
) -> Float[Array, "env member feature feature"]:
    """The square root of the covariance of one head of each member."""
    group = jnp.minimum(head, layer.root.shape[2] - 1)[..., None, None, None]
    return jnp.take_along_axis(layer.root, group, axis=2)[:, :, 0]


def noise_of(
    layer: LastLayer, prior: Prior, head: Int[Array, "env member"]
) -> Float[Array, "env member obs"]:
    """Variance of the noise in the episode, of one head of each member."""
    noise = layer.noise(prior)
    return jnp.take_along_axis(noise, head[..., None, None], axis=2)[:, :, 0]


def correction_variance(
    layer: LastLayer,
    prior: Prior,
    head: Int[Array, "env member"],
    features: Float[Array, "env member feature"],
) -> Float[Array, "env member obs"]:
    """Variance φᵀPφ σ² of what one head of each member adds, in normalised units."""
    projected = jnp.einsum("emij,emi->emj", root_of(layer, head), features)
    return jnp.square(projected).sum(-1, keepdims=True) * noise_of(layer, prior, head)
