"""Multi-headed, context-conditional networks (supplement A.3), and how they act.

T-MCL, and all that its settings express. Which head plans is equation 3 of the paper (released
`core/utils.py`).
"""

import dataclasses
import functools
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray

from headway.config import ContextKind, ModelConfig, PlannerConfig, Precision
from headway.data import History
from headway.errors import ConfigError
from headway.models import last_layer
from headway.models.base import Keys, Model, RecentTransitions, Transition
from headway.models.folding import Context, FoldedDynamics, fold
from headway.models.last_layer import LastLayer, Prior, Residuals
from headway.models.networks import ContextEncoder, Dense, GaussianNet
from headway.models.statistics import Statistics, flat_history, network_input
from headway.task import Task

ERROR_DRAWS = 20  # noise draws of the released code's sampled error


class MultiHeadNet(eqx.Module):
    """An ensemble of multi-headed networks, with optional context and backward net."""

    forward_net: GaussianNet
    """Predicts the change from an observation to the next."""
    backward_net: GaussianNet | None
    """Predicts the change back; it only shapes the context."""
    context_encoder: ContextEncoder | None
    """Turns past transitions into a context."""
    relation_head: Dense | None = None
    """Tells from two contexts, one after the other, whether they are of one trajectory."""
    context_kind: ContextKind = eqx.field(static=True, default="learned")
    """Source of the networks' knowledge of the hidden physics."""
    sim_param_names: tuple[str, ...] = eqx.field(static=True, default=())
    """The true simulator parameters that are its context, in their order; mostly none."""

    @classmethod
    def init(
        cls,
        config: ModelConfig,
        task: Task,
        *,
        sim_param_names: tuple[str, ...] = (),
        key: PRNGKeyArray,
    ) -> "MultiHeadNet":
        """Draw initial weights for a task's sizes.

        Args:
            config: Settings of the model.
            task: The sizes of observations and actions.
            sim_param_names: The simulator parameters that a model with `sim-params` as context
                is told.
            key: Draws the weights.
        """
        forward_key, backward_key, context_key = jax.random.split(key, 3)
        history_size = config.history_length * (task.obs_size + task.action_size)
        width = {
            "learned": config.context_size,
            "history": history_size,
            "sim-params": len(sim_param_names),
        }[config.context]

        draw = functools.partial(GaussianNet.init, config, task, width)
        outcomes = 2 * config.learned_reward
        forward = draw(deterministic=config.deterministic, outcomes=outcomes, key=forward_key)
        backward = encoder = relation = None
        if config.backward_net:
            deterministic = config.deterministic or config.backward_deterministic
            backward = draw(deterministic=deterministic, key=backward_key)
        if config.context == "learned" and width:
            encoder = ContextEncoder.init(config, history_size, key=context_key)
        if config.relation_head:
            relation_key = jax.random.fold_in(key, 3)
            relation = Dense.init((config.num_members,), 2 * width, 1, key=relation_key)
        return cls(forward, backward, encoder, relation, config.context, sim_param_names)

    def in_precision(self, precision: Precision) -> "MultiHeadNet":
        """The model with products in a precision, but for the relation head and some first layers.

        Those of the networks that predict take observations, whose digits reduced precision would
        lose; the context encoder takes differences of them.
        """
        if precision == "float32":
            return self
        nets = [net for net in (self.forward_net, self.backward_net) if net is not None]
        exact = [self.relation_head, *(net.hidden[0] for net in nets)]

        def reduce(layer: Dense | Array) -> Dense | Array:
            if not isinstance(layer, Dense) or any(layer is one for one in exact):
                return layer
            return dataclasses.replace(layer, precision=precision)

        return jax.tree.map(reduce, self, is_leaf=lambda part: isinstance(part, Dense))

    @property
    def num_members(self) -> int:
        """Networks in the ensemble."""
        return self.forward_net.mean_heads.weight.shape[0]

    @property
    def num_heads(self) -> int:
        """Prediction heads of each network."""
        return self.forward_net.mean_heads.weight.shape[1]

    def context(
        self,
        history: History,
        statistics: Statistics,
        sim_params: Float[Array, "member batch sim_param"] | None = None,
    ) -> Float[Array, "member batch context"] | None:
        """Context vector of the hidden physics; None where networks are told nothing.

        Args:
            history: Past transitions, [member, batch, K, ...].
            statistics: The normalisers in use.
            sim_params: The true simulator parameters, for a model that is told them.
        """
        if self.context_kind == "sim-params":
            assert statistics.sim_params is not None
            assert sim_params is not None
            return statistics.sim_params.normalize(sim_params)
        if self.context_kind == "history":
            return flat_history(history, statistics)
        if self.context_encoder is None:
            return None
        return self.context_encoder(flat_history(history, statistics))

    def residuals(
        self,
        task: Task,
        statistics: Statistics,
        transition: tuple[Array, Array, Array],
        context: Float[Array, "member env context"] | None,
    ) -> Residuals:
        """Compare one transition per environment with every head's prediction.

        Args:
            task: How observations enter and leave the model.
            statistics: The normalisers in use.
            transition: Observations, actions in [-1, 1], next observations; [env, ...].
            context: The context vectors that the heads plan with.
        """
        obs, action, next_obs = transition
        x = network_input(task, statistics, obs, action).mT
        x = jnp.broadcast_to(x, (self.num_members, *x.shape))
        features = self.forward_net.head_input(x, None if context is None else context.mT)
        delta = statistics.delta.normalize(task.target(obs, next_obs)).mT
        mean, logvar = jax.tree.map(
            lambda x: x[:, :, : len(delta)], self.forward_net.predict(features)
        )
        residual = delta - mean
        features = jnp.concatenate([features, jnp.ones_like(features[:, :1])], axis=1)
        return jax.tree.map(lambda x: jnp.moveaxis(x, -1, 0), Residuals(features, residual, logvar))


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

    net: MultiHeadNet
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
        shape = jax.eval_shape(self.context, recent, sim_params)
        context = None if shape is None else jnp.zeros(shape.shape)
        heads = jnp.zeros((num_envs, self.net.num_members), jnp.int32)
        return MultiHeadBelief(recent, context, heads, layer, sim_params)

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
        sampling_key = error_key if planner.selection_error == "sampled" else None
        errors = self.head_errors((obs, action, next_obs), context, sampling_key=sampling_key)
        return select_heads(errors, used, key=head_key)

    def head_errors(
        self,
        transitions: tuple[Array, Array, Array],
        context: Context,
        *,
        sampling_key: PRNGKeyArray | None = None,
    ) -> Float[Array, "env member head slot"]:
        """Squared error of every head, averaged over dimensions.

        The error of the predicted mean in normalised units, with one context for all transitions
        of an environment. With a `sampling_key`, the error of sampled deltas in raw units, as the
        released code has it.

        Args:
            transitions: Observations, actions in [-1, 1], next observations; [env, slot, ...].
            context: Of every member and environment.
            sampling_key: Draws the samples.
        """
        num_envs, num_slots = transitions[0].shape[:2]
        rows = jax.tree.map(lambda x: x.reshape(num_envs * num_slots, -1), transitions)
        if context is not None:
            context = jnp.repeat(context, num_slots, axis=1)
        seen = self.net.residuals(self.task, self.statistics, rows, context)
        squared = jnp.square(seen.residual).mean(-1)
        if sampling_key is not None:
            sampled = seen.residual[None]
            if seen.logvar is not None:
                rows, *nets, obs_size = seen.logvar.shape
                draws = jax.random.normal(sampling_key, (ERROR_DRAWS, *nets, rows, obs_size))
                sampled = sampled - jnp.moveaxis(draws, 3, 1) * jnp.exp(0.5 * seen.logvar)
            squared = jnp.square(sampled * self.statistics.delta.std).mean((0, -1))
        return jnp.moveaxis(squared.reshape(num_envs, num_slots, *squared.shape[1:]), 1, -1)

    def dynamics(self, belief: MultiHeadBelief, precision: Precision = "float32") -> FoldedDynamics:
        """See `Model.dynamics`: the chosen heads, or all of them where they are averaged."""
        heads = belief.heads[..., None]
        if self.planner.head_selection == "average":
            num_heads = self.net.num_heads
            heads = jnp.broadcast_to(jnp.arange(num_heads), (*belief.heads.shape, num_heads))
        correction = None if belief.last_layer is None else belief.last_layer.weight
        whole = self.net.forward_net, self.statistics, self.task
        return fold(*whole, heads, belief.context, precision=precision, correction=correction)


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
