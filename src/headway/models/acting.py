"""Multi-headed networks as they act: context, choice of heads, the networks folded for a plan.

T-MCL, and all that its settings express. Which head plans is equation 3 of the paper (released
`core/utils.py`).
"""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray

from headway.config import PlannerConfig, Precision
from headway.errors import ConfigError
from headway.models import last_layer
from headway.models.base import (
    Dynamics,
    Keys,
    Layer,
    Model,
    RecentTransitions,
    Transition,
    over_rows,
    plan_layers,
)
from headway.models.last_layer import LastLayer, Prior
from headway.models.multi_headed import MultiHeadDynamics, Statistics, network_input
from headway.models.networks import PRECISIONS, Dense, DenseHeads, swish
from headway.task import Task

ERROR_DRAWS = 20  # noise draws of the released code's sampled error

Context = Float[Array, "member env context"] | None


class MultiHeadBelief(NamedTuple):
    """Belief of multi-headed networks about each environment."""

    recent: RecentTransitions
    context: Context
    heads: Int[Array, "env member"]
    """The head that each member plans with; with `average`, the one that would be adaptive."""
    last_layer: LastLayer | None
    """Corrections that the heads learned in this episode; None where they learn nothing."""
    sim_params: Float[Array, "env sim_param"] | None
    """The true simulator parameters, for a model that is told them."""


class MultiHeadModel(Model):
    """Trained networks with all that they need to act."""

    net: MultiHeadDynamics
    statistics: Statistics
    task: Task
    planner: PlannerConfig = eqx.field(static=True)
    """Settings of head selection and of heads that keep learning."""
    history_length: int = eqx.field(static=True)
    prior: Prior | None = None
    """Start of heads that keep learning; `fit_prior` finds it."""

    def __check_init__(self):
        if self.planner.adaptation != "none" and self.prior is None:
            raise ConfigError(
                "planner.adaptation is 'last-layer', but the model has no prior; make it with"
                " headway.models.last_layer_prior.fit_prior, or set planner.adaptation to none."
            )

    @property
    def sim_param_names(self) -> tuple[str, ...]:
        """See `Model.sim_param_names`."""
        return self.net.sim_param_names

    @property
    def memory(self) -> int | None:
        """See `Model.memory`; heads that learn do so all through an episode."""
        if self.prior is not None:
            return None
        return max(self.history_length, self.planner.selection_length)

    def init_belief(
        self, num_envs: int, sim_params: Float[Array, "env sim_param"] | None = None
    ) -> MultiHeadBelief:
        """See `Model.init_belief`."""
        slots = max(self.history_length, self.planner.selection_length)
        recent = RecentTransitions.empty(num_envs, slots, self.task)
        layer = None
        if self.prior is not None and self.planner.adaptation != "none":
            layer = LastLayer.init(self.prior, num_envs, self.net.num_heads)
        encoder, (obs, action, *_) = self.net.context_encoder, recent
        width = {
            "learned": 0 if encoder is None else encoder.output.bias.shape[-1],
            "history": self.history_length * (obs.shape[-1] + action.shape[-1]),
            "sim-params": len(self.sim_param_names),
        }[self.net.context_kind]
        return MultiHeadBelief(
            recent,
            jnp.zeros((self.net.num_members, num_envs, width)) if width else None,
            jnp.zeros((num_envs, self.net.num_members), jnp.int32),
            layer,
            sim_params,
        )

    def observe(
        self, belief: MultiHeadBelief, transition: Transition, keys: Keys
    ) -> MultiHeadBelief:
        """See `Model.observe`: encode the past, learn from the transition, choose heads."""
        recent = belief.recent.push(transition)
        context = self.context(recent, belief.sim_params)
        layer = belief.last_layer
        if layer is not None and self.prior is not None:
            layer = last_layer.observe(
                layer,
                self.prior,
                self.net.residuals(self.task, self.statistics, transition[:3], context),
                transition.happened,
                self.planner.change_threshold,
            )
        heads = self.choose_heads(recent, context, keys)
        return MultiHeadBelief(recent, context, heads, layer, belief.sim_params)

    def context(
        self, recent: RecentTransitions, sim_params: Float[Array, "env sim_param"] | None = None
    ) -> Context:
        """Context of each member from the recent past; None where networks see no context."""
        members = self.net.num_members
        history, sim_params = jax.tree.map(
            lambda x: jnp.broadcast_to(x, (members, *x.shape)),
            (recent.history(self.history_length), sim_params),
        )
        return self.net.context(history, self.statistics, sim_params)

    def choose_heads(
        self, recent: RecentTransitions, context: Context, keys: Keys
    ) -> Int[Array, "env member"]:
        """The head of least error on the last N transitions; a random one where there is none.

        The released code leaves out the newest transition and thus sees N - 1.
        """
        head_key, error_key = keys
        planner, skipped = self.planner, int(self.planner.selection_skips_newest)
        slots = recent.obs.shape[1]
        newest = slice(slots - planner.selection_length, slots - skipped)
        obs, action, next_obs = (x[:, newest] for x in recent[:3])
        num_slots, available = obs.shape[1], recent.count - skipped
        used = jnp.arange(num_slots) >= num_slots - available[:, None]
        if planner.head_selection == "random":
            used = jnp.zeros_like(used)
        sampling_key = error_key if planner.selection_error == "sampled" else None
        errors = head_errors(self, (obs, action, next_obs), context, sampling_key=sampling_key)
        return select_heads(errors, used, key=head_key)

    def dynamics(
        self, belief: MultiHeadBelief, precision: Precision = "float32"
    ) -> "FoldedDynamics":
        """See `Model.dynamics`: the chosen heads, or all of them where they are averaged."""
        heads = belief.heads[..., None]
        if self.planner.head_selection == "average":
            num_heads = self.net.num_heads
            heads = jnp.broadcast_to(jnp.arange(num_heads), (*belief.heads.shape, num_heads))
        correction = None if belief.last_layer is None else belief.last_layer.weight
        return fold(self, heads, belief.context, precision=precision, correction=correction)


def head_errors(
    model: MultiHeadModel,
    transitions: tuple[
        Float[Array, "env slot obs"], Float[Array, "env slot action"], Float[Array, "env slot obs"]
    ],
    context: Context,
    *,
    sampling_key: PRNGKeyArray | None = None,
) -> Float[Array, "env member head slot"]:
    """Squared error of every head, averaged over dimensions.

    The error of the predicted mean in normalised units, with one context for all transitions
    of an environment. With a `sampling_key`, the error of sampled deltas in raw units, as the
    released code has it.

    Args:
        model: The networks, with their task and normalisers.
        transitions: Observations, actions in [-1, 1], next observations.
        context: Of every member and environment.
        sampling_key: Draws the samples.
    """
    obs, action, next_obs = transitions
    num_envs, num_slots = obs.shape[:2]
    members, statistics = model.net.num_members, model.statistics
    x = network_input(model.task, statistics, obs, action).reshape(num_envs * num_slots, -1)
    x = jnp.broadcast_to(x, (members, *x.shape))
    if context is not None:
        context = jnp.repeat(context, num_slots, axis=1)
    prediction = model.net.forward_net(x, context)
    delta = model.task.target(obs, next_obs).reshape(num_envs * num_slots, -1)
    if sampling_key is None:
        squared = jnp.square(prediction.mean - statistics.delta.normalize(delta)).mean(-1)
    else:
        sample = prediction.mean[None]
        if prediction.logvar is not None:
            draws = jax.random.normal(sampling_key, (ERROR_DRAWS, *prediction.mean.shape))
            sample = prediction.mean + draws * jnp.exp(0.5 * prediction.logvar)
        squared = jnp.square(statistics.delta.denormalize(sample) - delta).mean((0, -1))
    return squared.reshape(members, -1, num_envs, num_slots).transpose(2, 0, 1, 3)


def select_heads(
    errors: Float[Array, "env member head slot"],
    used: Bool[Array, "env slot"],
    *,
    key: PRNGKeyArray,
) -> Int[Array, "env member"]:
    """The head that best explains the used transitions; a random one when there is none.

    Ties go to the lower index; a non-finite error never wins over a finite one.
    """
    total = jnp.where(used[:, None, None, :], errors, 0.0).sum(-1)
    best = jnp.argmin(jnp.where(jnp.isfinite(total), total, jnp.inf), axis=-1)
    drawn = jax.random.randint(key, best.shape, 0, errors.shape[2])
    return jnp.where(used.any(-1)[:, None], best, drawn)


class OwnHeads(NamedTuple):
    """Weights of a plan that differ by environment: its heads, and the context in a hidden layer.

    Means and log-variances come out of one product: the layer's outputs are the mean delta in
    raw units (averaged over the choices), then each choice's log-variance.
    """

    layer: Layer
    min_logvar: Float[Array, "*env member choice obs"] | None
    max_logvar: Float[Array, "*env member choice obs"] | None
    context_bias: Float[Array, "*env member out"] | None
    """Bias of the hidden layer that the context joins; None if it joins the heads."""


class FoldedDynamics(Dynamics):
    """Multi-headed networks with all that is fixed during one plan folded into their weights.

    Only the chosen heads remain, one set per environment and member; the context has become
    part of the biases where it joins; normalisation has gone into the first layer and
    de-normalisation into the heads. With several chosen heads the sampled delta is the average
    of their samples (non-adaptive planning), drawn in one go.
    """

    own: OwnHeads
    hidden: tuple[Layer, ...]
    delta_std: Float[Array, " obs"]
    task: Task
    context_layer: int | None = eqx.field(static=True)
    """The hidden layer that the context joins; None if it joins the heads."""

    @property
    def widest(self) -> int:
        """See `Dynamics.widest`."""
        return max(layer.bias.shape[-1] for layer in self.hidden)

    @property
    def num_members(self) -> int:
        """Networks in the ensemble."""
        return self.hidden[0].bias.shape[0]

    @property
    def stochastic(self) -> bool:
        """True where deltas have a variance."""
        return self.own.min_logvar is not None

    def of_member(self, member: Int[Array, ""]) -> "FoldedDynamics":
        """See `Dynamics.of_member`."""
        hidden, own = jax.tree.map(
            lambda x: jax.lax.dynamic_slice_in_dim(x, member, 1), (self.hidden, self.own)
        )
        return FoldedDynamics(own, hidden, self.delta_std, self.task, self.context_layer)

    def step(
        self,
        carry: tuple[()],
        obs: Float[Array, "member obs particle candidate"],
        action: Float[Array, "member action particle candidate"],
        noise: Float[Array, "member obs particle #candidate"] | None,
    ) -> tuple[tuple[()], Float[Array, "member obs particle candidate"]]:
        """See `Dynamics.step`: a sample of the next delta, or its mean without noise."""
        heads, low, high, context_bias = self.own
        activation = rough_swish if heads.weight.dtype == jnp.bfloat16 else swish
        x = jnp.concatenate([over_rows(self.task.preprocess)(obs), action], axis=1)
        for index, layer in enumerate(self.hidden):
            if index == self.context_layer and context_bias is not None:
                layer = layer._replace(bias=context_bias)  # noqa: PLW2901
            x = activation(layer(x))
        out, obs_size = heads(x), obs.shape[1]
        delta = out[:, :obs_size]
        if noise is not None and low is not None and high is not None:
            members, choices, _ = low.shape
            logvar = out[:, obs_size:].reshape(members, choices, obs_size, *out.shape[2:])
            var = bounded_var(logvar, low[..., None, None], high[..., None, None])
            std = jnp.sqrt(var.sum(1)) * (self.delta_std / choices)[:, None, None]
            delta = delta + noise * std
        return carry, over_rows(self.task.postprocess)(obs, delta)


def fold(
    model: MultiHeadModel,
    heads: Int[Array, "env member choice"],
    context: Context,
    *,
    precision: Precision = "float32",
    correction: Float[Array, "env member head feature obs"] | None = None,
) -> FoldedDynamics:
    """Fold networks for one plan.

    Args:
        model: The networks, with their task and normalisers.
        heads: The chosen heads; one per environment and member, or all of them.
        context: Of every member and environment.
        precision: Of the products; the first layer and the sums stay in float32.
        correction: Added to the weights of the mean heads, the last row to their biases.
    """
    net, statistics, place = (
        model.net.forward_net,
        model.statistics,
        model.net.forward_net.context_layer,
    )
    hidden, context_bias = list(net.hidden), None
    if context is not None and place is not None:
        # The rows that take the context become a bias, each environment's own.
        weight, bias = hidden[place].weight, hidden[place].bias
        width = weight.shape[1] - context.shape[-1]
        hidden[place] = Dense(weight[:, :width], bias)
        context_bias = jnp.einsum("mec,mco->emo", context, weight[:, width:])
        context = None
    # The first layer takes raw features and actions.
    scale = jnp.concatenate([statistics.features.scale, statistics.action.scale])
    mean = jnp.concatenate([statistics.features.mean, statistics.action.mean])
    weight = hidden[0].weight / scale[:, None]
    hidden[0] = Dense(weight, hidden[0].bias - jnp.einsum("i,mio->mo", mean, weight))
    layers = plan_layers(hidden, precision)
    if context_bias is not None and place is not None:
        context_bias = layers[place].bias + context_bias
    # Heads give raw deltas, averaged over the choices, and log-variances of each.
    delta, low, high = statistics.delta, None, None
    weight, bias = _chosen(net.mean_heads, heads, context, correction)
    weights = [weight.mean(2) * delta.std]
    biases = [bias.mean(2) * delta.std + delta.mean]
    if net.logvar_heads is not None:
        weight, bias = _chosen(net.logvar_heads, heads, context)
        num_envs, members, _, hidden_size, _ = weight.shape
        weights.append(weight.transpose(0, 1, 3, 2, 4).reshape(num_envs, members, hidden_size, -1))
        biases.append(bias.reshape(num_envs, members, -1))
        low, high = net.min_logvar[heads], net.max_logvar[heads]
    weight = jnp.concatenate(weights, axis=-1).mT.astype(PRECISIONS[precision])
    own = OwnHeads(Layer(weight, jnp.concatenate(biases, axis=-1)), low, high, context_bias)
    return FoldedDynamics(own, layers, delta.std, model.task, place)


def _chosen(
    layer: DenseHeads,
    heads: Int[Array, "env member choice"],
    context: Context,
    correction: Float[Array, "env member head feature obs"] | None = None,
) -> tuple[Float[Array, "env member choice hidden obs"], Float[Array, "env member choice obs"]]:
    """Weights and biases of the chosen heads, the context added to the biases."""
    member = jnp.arange(heads.shape[1])[:, None]
    weight, bias = layer.weight[member, heads], layer.bias[member, heads]
    if correction is not None:
        env = jnp.arange(len(heads))[:, None, None]
        chosen = correction[env, member, heads]
        weight, bias = weight + chosen[..., :-1, :], bias + chosen[..., -1, :]
    if context is None:
        return weight, bias
    hidden_size = weight.shape[-2] - context.shape[-1]
    bias = bias + jnp.einsum("mec,emkco->emko", context, weight[..., hidden_size:, :])
    return weight[..., :hidden_size, :], bias


def bounded_var(
    logvar: Float[Array, "..."], low: Float[Array, "..."], high: Float[Array, "..."]
) -> Float[Array, "..."]:
    """`exp(bound_logvar(...))`, in which all logarithms cancel: one exponential instead of five."""
    return jnp.exp(low) + 1.0 / (jnp.exp(-high) + jnp.exp(-logvar))


def rough_swish(x: Float[Array, "*shape"]) -> Float[Array, "*shape"]:
    """`swish` to within 2e-4, a tenth of what rounding to bfloat16 takes from a number near 1.

    Its tanh is a quotient of polynomials of lower degree than XLA's, fitted to the least
    largest error of swish.
    """
    half = 0.5 * x
    bounded = jnp.clip(half, -5.4, 5.4)
    square = jnp.square(bounded)
    above = 0.998925793 + square * (0.098016076 + square * 5.71165459e-4)
    below = 1.0 + square * (0.429472208 + square * 0.0116753473)
    return half + half * (bounded * above / below)
