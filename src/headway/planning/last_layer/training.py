"""Training for adaptation: features from which heads learn quickly.

An ordinary fit asks how well a head predicts. The loss here asks how well it predicts once it
has learned, in closed form, from what the episode has shown: the first n transitions of a
training episode are learned from as `regression` does while acting, and all later ones are
judged. Its gradient goes through what was learned into the features.

- **The later transitions**, not just the next one: a plan imagines many steps. They see the
  context of moment n, as a plan made then would.
- **n is log-uniform**, because the posterior changes most in the beginning.
- **Two heads per task**, the one that explains the episode best and the second best. The first is
  what acts on known physics; the second imitates physics that no head was made for, with no data
  but those of training.
- **Heads are held fixed** in this loss: the ordinary loss goes on beside it and alone decides what
  each head is made for. Else the second-best head would be drawn to the physics of the best.
- **The noise is as large at all transitions** of a task, and its variance the most likely one for
  each head and dimension. So tasks count by how much better they become, not by how large their
  errors are.

ALPaCA (Harrison et al., 2018) trains features through the same regression, for one network
without heads.
"""

import dataclasses
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray

from headway.models.dynamics import MultiHeadDynamics
from headway.models.fitting import FitData, FitSetup
from headway.planning.last_layer.evidence import MIN_NOISE
from headway.planning.last_layer.regression import (
    LastLayer,
    Observed,
    Prior,
    forecast,
    heads_by_error,
    see_episode,
    update,
)
from headway.tasks.base import Task

STEP = 0.1
"""Adam's step, as a share of `fitting.learning_rate`."""


def for_adaptation(setup: FitSetup) -> FitSetup:
    """The same setup with the smaller steps of these epochs."""
    config = dataclasses.replace(setup.config, learning_rate=STEP * setup.config.learning_rate)
    return FitSetup(setup.task, config, setup.history_length)


class Moment(NamedTuple):
    """A moment of a training episode: what came before is learned from."""

    episode: Int[Array, ""]
    step: Int[Array, ""]
    """Transitions before it (n)."""

    @classmethod
    def draw(cls, data: FitData, key: PRNGKeyArray) -> "Moment":
        """Draw an episode in proportion to its length, and a step at least 1, log-uniformly."""
        row_key, step_key = jax.random.split(key)
        episode = data.samples.episode[jax.random.randint(row_key, (), 0, data.samples.count)]
        length = data.episodes.length[episode]
        step = jnp.floor(length ** jax.random.uniform(step_key)).astype(length.dtype)
        return cls(episode, jnp.clip(step, 1, jnp.maximum(length - 1, 1)))


class AdaptationLoss(eqx.Module):
    """How badly heads predict the rest of a random training episode, having learned so far."""

    task: Task
    history_length: int = eqx.field(static=True)
    prior: Prior
    """Where heads begin to learn: the one they will act with."""

    def __call__(
        self, model: MultiHeadDynamics, data: FitData, key: PRNGKeyArray
    ) -> Float[Array, ""]:
        """Draw an episode and a moment, the same for all members; the sum over members."""
        return self.at(model, data, Moment.draw(data, key)).sum()

    def at(
        self, model: MultiHeadDynamics, data: FitData, moment: Moment
    ) -> Float[Array, " member"]:
        """The loss of each member at one moment."""
        steps = jnp.arange(data.episodes.action.shape[1])
        learned = steps < moment.step
        judged = ~learned & (steps < data.episodes.length[moment.episode])
        seen = see_episode(
            with_fixed_heads(model),
            self.task,
            data.statistics,
            data.episodes,
            moment.episode,
            jnp.where(learned, steps + 1, moment.step),
            self.history_length,
        )
        residual = of_best_heads(seen.residual)
        loss = jax.vmap(loss_after_learning, in_axes=(1, 1, None, None, 0))
        features = self.prior.even(seen.features)
        return loss(features, residual, moment.step, judged, self.prior.ratio)


def with_fixed_heads(model: MultiHeadDynamics) -> MultiHeadDynamics:
    """The same model, whose heads no gradient reaches."""
    heads = jax.lax.stop_gradient(model.forward_net.mean_heads)
    return eqx.tree_at(lambda model: model.forward_net.mean_heads, model, heads)


def of_best_heads(
    residual: Float[Array, "time member head obs"], most: int = 2
) -> Float[Array, "time member rank obs"]:
    """Residuals of the heads that explain the episode best; `most` of them, if there are."""
    best = heads_by_error(residual)[:, :most]
    return jnp.take_along_axis(residual, best[None, :, :, None], axis=2)


def loss_after_learning(
    features: Float[Array, "time feature"],
    residual: Float[Array, "time rank obs"],
    learned: Int[Array, ""],
    judged: Bool[Array, " time"],
    ratio: Float[Array, ""],
) -> Float[Array, ""]:
    """Gaussian NLL of some transitions after earlier ones were learned from.

    In the units of `losses.negative_log_likelihood`: averaged over transitions, dimensions and
    heads, twice the log-density, without constants. 0 where there is nothing to judge.

    Args:
        features: Features whose weights are equally uncertain (`Prior.even`).
        residual: What the heads leave unexplained.
        learned: How many transitions are learned from (n), from the first one on.
        judged: Transitions to predict then.
        ratio: Of the prior (ρ).
    """
    error, spread = errors_after_learning(features, residual, learned, ratio)
    share = judged / jnp.maximum(judged.sum(), 1)
    noise = jnp.einsum("t,tko->ko", share / spread, jnp.square(error))
    loss = jnp.log(jnp.maximum(noise, MIN_NOISE)).mean() + (share * jnp.log(spread)).sum()
    return jnp.where(judged.any(), loss, 0.0)


def errors_after_learning(
    features: Float[Array, "time feature"],
    residual: Float[Array, "time rank obs"],
    learned: Int[Array, ""],
    ratio: Float[Array, ""],
) -> tuple[Float[Array, "time rank obs"], Float[Array, " time"]]:
    """What is left of all residuals after learning, and their predictive variance 1 + φᵀPφ.

    The variance is in units of that of the noise. Both are differentiated implicitly, with what
    the filter found held fixed: w solves Φᵀ(r − Φw) = w/ρ, and φᵀPφ is the largest value of
    2φᵀz − |Φz|² − |z|²/ρ, which is at z = Pφ. So no gradient goes back through the filter's steps.
    """
    weight, root = jax.lax.stop_gradient(learn_first(features, residual, learned, ratio))
    rows = jnp.where(jnp.arange(len(features))[:, None] < learned, features, 0.0)
    remains = residual - jnp.einsum("ti,iko->tko", rows, weight)
    balance = jnp.einsum("ti,tko->iko", rows, remains)
    change = jnp.einsum("ji,jko->iko", root, _only_gradient(balance))
    weight = weight + jnp.einsum("ij,jko->iko", root, change)
    projected = jax.lax.stop_gradient(features) @ root
    best = projected @ root.T
    value = 2.0 * (features * best).sum(-1) - jnp.square(best @ rows.T).sum(-1)
    spread = 1.0 + jnp.square(projected).sum(-1) + _only_gradient(value)
    return residual - jnp.einsum("ti,iko->tko", features, weight), spread


def learn_first(
    features: Float[Array, "time feature"],
    residual: Float[Array, "time rank obs"],
    learned: Int[Array, ""],
    ratio: Float[Array, ""],
) -> tuple[Float[Array, "feature rank obs"], Float[Array, "feature feature"]]:
    """Learn from the first transitions of an episode, as an agent does, one by one.

    No decomposition at once instead: batched calls of LAPACK can wait for each other forever in
    jaxlib 0.10 on two cores.

    Returns:
        The mean of the corrections, and S with P = S Sᵀ.
    """
    _, ranks, obs_size = residual.shape
    size, one = features.shape[-1], jnp.ones((1, 1, 1))
    prior = Prior(ratio[None], jnp.ones((1, obs_size)), jnp.zeros(1))

    def learn(step, layer):
        observed = Observed(features[None, None, step], residual[None, None, step], one)
        return update(layer, observed, forecast(layer, observed))

    start = LastLayer.of_prior(prior, 1, (ranks, size, obs_size))
    layer = jax.lax.fori_loop(0, learned, learn, start)
    return layer.weight[0, 0].transpose(1, 0, 2), layer.root[0, 0, 0]


def _only_gradient(values: Float[Array, "..."]) -> Float[Array, "..."]:
    """Zero, with the gradient of the values."""
    return values - jax.lax.stop_gradient(values)
