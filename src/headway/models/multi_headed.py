"""The multi-headed, context-conditional dynamics model (supplement A.3)."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PRNGKeyArray

from headway.config import ContextKind, ModelConfig, Precision
from headway.data import (
    History,
    Trajectory,
    history_action_moments,
    sim_params_row,
)
from headway.models.last_layer import Residuals
from headway.models.networks import ContextEncoder, Dense, DenseHeads, GaussianNet, Normalizer
from headway.task import Task


def context_size(config: ModelConfig, task: Task, num_sim_params: int) -> int:
    """Width of the context; 0 where the networks see none.

    Args:
        config: Settings of the model.
        task: The sizes of observations and actions.
        num_sim_params: Simulator parameters that a model with `sim-params` as context is told.
    """
    history = config.history_length * (task.obs_size + task.action_size)
    of_kind = {"learned": config.context_size, "history": history, "sim-params": num_sim_params}
    return of_kind[config.context]


class Statistics(eqx.Module):
    """Normalisers of everything that enters or leaves the networks; refitted, not learned."""

    features: Normalizer
    action: Normalizer
    delta: Normalizer
    backward_delta: Normalizer
    history_action: Normalizer
    sim_params: Normalizer | None = None
    """Only for a model that takes the true simulator parameters."""

    @classmethod
    def identity(
        cls, task: Task, history_length: int, sim_param_names: tuple[str, ...] = ()
    ) -> "Statistics":
        """Statistics before any data: nothing is scaled."""
        return cls(
            Normalizer.identity(task.feature_size),
            Normalizer.identity(task.action_size),
            Normalizer.identity(task.obs_size),
            Normalizer.identity(task.obs_size),
            Normalizer.identity(history_length, task.action_size),
            Normalizer.identity(len(sim_param_names)) if sim_param_names else None,
        )

    @classmethod
    def fit(
        cls,
        task: Task,
        trajectories: list[Trajectory],
        history_length: int,
        sim_param_names: tuple[str, ...] = (),
    ) -> "Statistics":
        """Recompute from all data so far, as at the start of every iteration.

        A simulator parameter that never varied is shifted to 0 and not scaled.

        Args:
            task: How observations enter and leave the model.
            trajectories: All data.
            history_length: Past transitions that a context is made of (K).
            sim_param_names: Simulator parameters that the model is told.
        """
        obs = jnp.asarray(np.concatenate([t.obs[:-1] for t in trajectories]))
        next_obs = jnp.asarray(np.concatenate([t.obs[1:] for t in trajectories]))
        told = None
        if sim_param_names:
            rows = np.stack([sim_params_row(t.sim_params, sim_param_names) for t in trajectories])
            told = Normalizer.fit(np.repeat(rows, [len(t) for t in trajectories], axis=0))
        return cls(
            Normalizer.fit(np.asarray(task.preprocess(obs))),
            Normalizer.fit(np.concatenate([t.action for t in trajectories])),
            Normalizer.fit(np.asarray(task.target(obs, next_obs))),
            Normalizer.fit(np.asarray(task.target(next_obs, obs))),
            Normalizer.of_moments(*history_action_moments(trajectories, history_length)),
            told,
        )


class MultiHeadDynamics(eqx.Module):
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
    ) -> "MultiHeadDynamics":
        """Draw initial weights for a task's sizes.

        Args:
            config: Settings of the model.
            task: The sizes of observations and actions.
            sim_param_names: The simulator parameters that a model with `sim-params` as context
                is told.
            key: Draws the weights.
        """
        forward_key, backward_key, context_key = jax.random.split(key, 3)
        width = context_size(config, task, len(sim_param_names))
        deterministic = config.deterministic
        forward = GaussianNet.init(
            config, task, width, deterministic=deterministic, key=forward_key
        )
        backward = encoder = relation = None
        if config.backward_net:
            deterministic = config.deterministic or config.backward_deterministic
            backward = GaussianNet.init(
                config, task, width, deterministic=deterministic, key=backward_key
            )
        if config.context == "learned" and width:
            history_size = config.history_length * (task.obs_size + task.action_size)
            encoder = ContextEncoder.init(config, history_size, key=context_key)
        if config.relation_head:
            relation_key = jax.random.fold_in(key, 3)
            relation = Dense.init(config.num_members, 2 * width, 1, key=relation_key)
        return cls(forward, backward, encoder, relation, config.context, sim_param_names)

    def in_precision(self, precision: Precision) -> "MultiHeadDynamics":
        """The model with products in a precision, but for the relation head and some first layers.

        Those of the networks that predict take observations, whose digits reduced precision would
        lose; the context encoder takes differences of them.
        """
        if precision == "float32":
            return self

        def inner_layers(model: MultiHeadDynamics) -> list[Dense | DenseHeads]:
            nets = [net for net in (model.forward_net, model.backward_net) if net is not None]
            layers = [layer for net in nets for layer in (*net.hidden[1:], net.mean_heads)]
            layers += [net.logvar_heads for net in nets if net.logvar_heads is not None]
            encoder = model.context_encoder
            return layers if encoder is None else [*layers, *encoder.hidden, encoder.output]

        return eqx.tree_at(
            inner_layers,
            self,
            replace_fn=lambda layer: dataclasses.replace(layer, precision=precision),
        )

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
        transition: tuple[
            Float[Array, "env obs"], Float[Array, "env action"], Float[Array, "env obs"]
        ],
        context: Float[Array, "member env context"] | None,
    ) -> Residuals:
        """Compare one transition per environment with every head's prediction.

        Args:
            task: How observations enter and leave the model.
            statistics: The normalisers in use.
            transition: Observations, actions in [-1, 1], next observations.
            context: The context vectors that the heads plan with.
        """
        obs, action, next_obs = transition
        x = network_input(task, statistics, obs, action)
        x = jnp.broadcast_to(x, (self.num_members, *x.shape))
        head_input = self.forward_net.head_input(x, context)
        mean, logvar = self.forward_net.predict(head_input)
        residual = statistics.delta.normalize(task.target(obs, next_obs)) - mean
        one = jnp.ones((*head_input.shape[:-1], 1))
        return Residuals(
            jnp.concatenate([head_input, one], axis=-1).transpose(1, 0, 2),
            residual.transpose(2, 0, 1, 3),
            None if logvar is None else logvar.transpose(2, 0, 1, 3),
        )


def flat_history(
    history: History, statistics: Statistics
) -> Float[Array, "member batch K_times_obs_and_action"]:
    """Input of a context encoder; state differences are not normalised (released code)."""
    members, batch = history.action.shape[:2]
    action = statistics.history_action.normalize(history.action)
    flat = [history.obs_diff.reshape(members, batch, -1), action.reshape(members, batch, -1)]
    return jnp.concatenate(flat, axis=-1)


def network_input(
    task: Task,
    statistics: Statistics,
    obs: Float[Array, "*batch obs"],
    action: Float[Array, "*batch action"],
) -> Float[Array, "*batch in"]:
    """Input of a backbone: normalised features, then the normalised action."""
    features = statistics.features.normalize(task.preprocess(obs))
    return jnp.concatenate([features, statistics.action.normalize(action)], axis=-1)
