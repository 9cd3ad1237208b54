"""Fitting a model to the replay buffer: epochs on the device, one Adam step per batch.

Supplement A.2 and A.4; released `dynamics/tmcl.py`. Heads are assigned once per epoch over the
whole data set, then forward and backward losses are minimised in mini-batches.
"""

import functools
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import optax
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray

from headway.config import FittingConfig
from headway.data import Episodes, Samples, segment_sums
from headway.models.batches import Batch
from headway.models.compilation import in_each_precision
from headway.models.losses import (
    assign_heads,
    independent_loss,
    logvar_bound_loss,
    model_decay_loss,
    negative_log_likelihood,
    oracle_loss,
)
from headway.models.multi_headed import GaussianNet, MultiHeadDynamics, Statistics, network_input
from headway.models.relation import add_parts, intervene, relation_gradient, relation_parts
from headway.models.shuffling import permutations
from headway.models.updates import EpochStats, unless_broken
from headway.task import Task


class FitState(eqx.Module):
    """What fitting changes: the networks and Adam's moments, which persist over iterations."""

    model: MultiHeadDynamics
    optimizer: optax.OptState
    relation_optimizer: optax.OptState | None = None
    """Adam's moments for the relation loss, which has an Adam of its own (RIA)."""


class HeadLosses(NamedTuple):
    """NLL of every head on every sample, forwards and backwards in time."""

    forward: Float[Array, "member head sample"]
    backward: Float[Array, "member head sample"] | None


class Assignment(NamedTuple):
    """The winning head per member and segment (or sample), for each direction."""

    forward: Int[Array, "member *segment"]
    backward: Int[Array, "member *segment"] | None


class FitData(NamedTuple):
    """What an epoch reads; stays on the device while fitting."""

    episodes: Episodes
    samples: Samples
    rows: Int[Array, "member sample"]
    statistics: Statistics


class FitSetup(eqx.Module):
    """What fixes the compiled epoch: the task and the settings."""

    task: Task
    config: FittingConfig = eqx.field(static=True)
    history_length: int = eqx.field(static=True)

    @property
    def optimizer(self) -> optax.GradientTransformation:
        """Adam as in the supplement, A.2."""
        return optax.adam(self.config.learning_rate)

    @property
    def segment_length(self) -> int:
        """M: transitions that share a winning head; 1 for the transition-wise oracle."""
        return self.config.segment_length if self.config.oracle == "trajectory" else 1

    def init(self, model: MultiHeadDynamics) -> FitState:
        """Start fitting a new model."""
        parameters: Any = model
        state = FitState(model, self.optimizer.init(parameters))
        if model.relation_head is None:
            return state
        parameters = relation_parts(model)
        return FitState(model, state.optimizer, self.optimizer.init(parameters))

    def step(self, state: FitState, grads: Any, relation_grads: Any) -> FitState:
        """Take one Adam step.

        Args:
            state: Before the step.
            grads: The gradient, laid out as the model.
            relation_grads: That of the relation loss, laid out as `RelationParts`, if there is one.
        """
        changes, optimizer = self.optimizer.update(grads, state.optimizer)
        model = eqx.apply_updates(state.model, changes)
        if relation_grads is None:
            return FitState(model, optimizer)
        moments: Any = state.relation_optimizer
        changes, moments = self.optimizer.update(relation_grads, moments)
        return FitState(add_parts(model, changes), optimizer, moments)


def head_losses(
    model: MultiHeadDynamics, task: Task, statistics: Statistics, batch: Batch
) -> HeadLosses:
    """Loss of every head on every sample, with the context of the sample's history."""
    context = model.context(batch.history, statistics, batch.sim_params)

    def losses(net: GaussianNet, start, end, delta) -> Float[Array, "member head sample"]:
        x = network_input(task, statistics, start, batch.action)
        target = delta.normalize(task.target(start, end)).mT
        prediction = net.columns(x.mT, None if context is None else context.mT)
        return negative_log_likelihood(prediction, target[:, None], axis=-2)

    forward = losses(model.forward_net, batch.obs, batch.next_obs, statistics.delta)
    if model.backward_net is None:
        return HeadLosses(forward, None)
    backward = losses(model.backward_net, batch.next_obs, batch.obs, statistics.backward_delta)
    return HeadLosses(forward, backward)


def total_loss(
    model: MultiHeadDynamics,
    losses: HeadLosses,
    assignment: Assignment | None,
    weight: Float[Array, "member sample"],
    config: FittingConfig,
) -> tuple[Float[Array, ""], Float[Array, ""]]:
    """What is minimised (paper, section 3), and the forward prediction loss in it.

    Args:
        model: For its variance bounds and weights.
        losses: Loss of every head on every sample.
        assignment: The head that owns each sample; None trains all heads on all samples.
        weight: 1 for a sample, 0 for padding.
        config: Weights of the terms.
    """

    def reduce(direction, owner):
        if owner is None:
            return independent_loss(direction, weight)
        return oracle_loss(direction, owner, weight, config.reduction)

    bound = config.logvar_bound_weight
    forward = reduce(losses.forward, assignment and assignment.forward)
    loss = forward + bound * logvar_bound_loss(model.forward_net)
    if losses.backward is not None and model.backward_net is not None:
        backward = reduce(losses.backward, assignment and assignment.backward)
        backward = backward + bound * logvar_bound_loss(model.backward_net)
        loss = loss + config.backward_weight * backward
    decay = model_decay_loss(model, context=config.context_weight_decay)
    return loss + config.weight_decay * decay, forward


def assign_segments(
    model: MultiHeadDynamics, setup: FitSetup, episodes: Episodes, statistics: Statistics
) -> Assignment:
    """Find the winning head of every segment of every episode (paper, section 3).

    Each transition is predicted with its own context; forward and backward heads are chosen
    independently. Segments past an episode's end hold head 0 and are never used.

    Returns:
        Heads, [member, episode, segment].
    """
    members, steps = model.num_members, episodes.action.shape[1]
    num_segments = -(-steps // setup.segment_length)
    time = jnp.arange(steps)

    def assign_episode(episode: Int[Array, ""]) -> Assignment:
        losses = episode_losses(model, setup, episodes, episode, statistics)
        valid = time < episodes.length[episode]
        return Assignment(*jax.tree.map(lambda loss: winners(loss, valid), losses))

    def winners(losses: Float[Array, "member head time"], valid: Bool[Array, " time"]):
        return assign_heads(segment_sums(losses, valid, setup.segment_length))

    def write(episode, assignment):
        found = assign_episode(episode)
        return jax.tree.map(lambda all_, one: all_.at[:, episode].set(one), assignment, found)

    empty = jnp.zeros((members, len(episodes.length), num_segments), jnp.int32)
    start = Assignment(empty, None if model.backward_net is None else empty)
    return jax.lax.fori_loop(0, episodes.count, write, start)


def episode_losses(
    model: MultiHeadDynamics,
    setup: FitSetup,
    episodes: Episodes,
    episode: int | Int[Array, ""],
    statistics: Statistics,
) -> HeadLosses:
    """Loss of every head along one episode, each transition with its own context."""
    obs, action = episodes.obs[episode], episodes.action[episode]
    time = jnp.arange(len(action))
    row = jnp.full_like(time, episode)
    past = episodes.history(row, time, setup.history_length)
    physics = episodes.sim_params[row]
    batch = Batch(obs[:-1], action, obs[1:], past, jnp.ones(len(action)), physics)
    members = model.num_members
    batch = jax.tree.map(lambda x: jnp.broadcast_to(x, (members, *x.shape)), batch)
    model = model.in_precision(setup.config.precision)
    return head_losses(model, setup.task, statistics, batch)


def gather_batch(
    data: FitData,
    assignment: Assignment | None,
    order: Int[Array, "member sample"],
    weight: Float[Array, "member sample"],
    setup: FitSetup,
) -> tuple[Batch, Assignment | None]:
    """Fetch the samples of one update and the heads that own them."""
    rows = jnp.take_along_axis(data.rows, order, axis=1)
    episode, anchor = data.samples.episode[rows], data.samples.anchor[rows]
    step = anchor + data.samples.offset[rows]
    episodes = data.episodes

    batch = Batch(
        obs=episodes.obs[episode, step],
        action=episodes.action[episode, step],
        next_obs=episodes.obs[episode, step + 1],
        history=episodes.history(episode, anchor, setup.history_length),
        weight=weight,
        sim_params=episodes.sim_params[episode],
        trajectory=episode,
    )
    if assignment is None:
        return batch, None
    member = jnp.arange(order.shape[0])[:, None]
    segment = anchor // setup.segment_length
    return batch, jax.tree.map(lambda heads: heads[member, episode, segment], assignment)


def update(
    state: FitState,
    setup: FitSetup,
    data: FitData,
    batch: Batch,
    owners: Assignment | None,
) -> tuple[FitState, tuple[Float[Array, ""], Float[Array, ""], Bool[Array, ""]]]:
    """Take one Adam step; a step with a non-finite loss or gradient is skipped."""

    def objective(model):
        reduced = model.in_precision(setup.config.precision)
        losses = head_losses(reduced, setup.task, data.statistics, batch)
        loss, forward = total_loss(model, losses, owners, batch.weight, setup.config)
        if model.relation_head is None:
            return loss, (forward, None)
        pull, similar = intervene(model, setup.task, data.statistics, batch, setup.config)
        return loss + pull, (forward, similar)

    (loss, (forward, similar)), grads = jax.value_and_grad(objective, has_aux=True)(state.model)
    relation_loss, relation_grads = jnp.zeros(()), None
    if similar is not None:
        # Both gradients are taken at the same weights, each with an Adam of its own.
        decay = setup.config.weight_decay
        relation_loss, relation_grads = relation_gradient(
            state.model, data.statistics, batch, similar, decay
        )
    taken = functools.partial(setup.step, state, grads, relation_grads)
    state, skipped = unless_broken(taken, state, loss + relation_loss, (grads, relation_grads))
    return state, (jnp.where(skipped, 0.0, loss), jnp.where(skipped, 0.0, forward), skipped)


def one_epoch(
    state: FitState,
    setup: FitSetup,
    data: FitData,
    *,
    independent: bool,
    key: PRNGKeyArray,
) -> tuple[FitState, EpochStats]:
    """Assign heads, shuffle per member, and go once through the data.

    Args:
        state: Networks and optimiser.
        setup: Task and settings.
        data: The data set, with its normalisers.
        independent: Train every head on all samples (warm-up, or `oracle="independent"`).
        key: Shuffles the samples.
    """
    assignment = None
    if not independent:
        assignment = assign_segments(state.model, setup, data.episodes, data.statistics)
    order = shuffle(data, setup.config.batch_size, key)
    size = setup.config.batch_size
    num_updates = -(-data.samples.count // size)

    def step(i, carry):
        state, loss, forward, skipped = carry
        chunk = jax.lax.dynamic_slice_in_dim(order, i * size, size, axis=1)
        weight = jnp.broadcast_to(
            (i * size + jnp.arange(size) < data.samples.count).astype(jnp.float32), chunk.shape
        )
        batch, owners = gather_batch(data, assignment, chunk, weight, setup)
        state, (one_loss, one_forward, bad) = update(state, setup, data, batch, owners)
        return state, loss + one_loss, forward + one_forward, skipped + bad

    zero = jnp.zeros(())
    carry = state, zero, zero, jnp.zeros((), jnp.int32)
    state, loss, forward, skipped = jax.lax.fori_loop(0, num_updates, step, carry)
    used = jnp.maximum(num_updates - skipped, 1)
    return state, EpochStats(loss / used, forward / used, skipped, num_updates)


_COMPILED = in_each_precision(one_epoch)


@functools.wraps(one_epoch)
def fit_epoch(state: FitState, setup: FitSetup, *args: Any, **named: Any) -> Any:
    """`one_epoch`, compiled for the precision of the fit."""
    return _COMPILED[setup.config.precision](state, setup, *args, **named)


def shuffle(data: FitData, batch_size: int, key: PRNGKeyArray) -> Int[Array, "member sample"]:
    """Permute the valid samples of each member; padding stays behind them.

    The result is padded to a whole number of batches.
    """
    members, capacity = data.rows.shape
    order = permutations(key, (members, capacity), data.samples.count)
    return jnp.pad(order, ((0, 0), (0, -capacity % batch_size)))


def make_data(
    episodes: Episodes,
    samples: Samples,
    statistics: Statistics,
    config: FittingConfig,
    *,
    num_members: int,
    key: PRNGKeyArray,
) -> FitData:
    """Bring together what an epoch reads.

    Args:
        episodes: The padded trajectories.
        samples: The valid samples of them.
        statistics: Normalisers fitted to the same trajectories.
        config: With `bootstrap`, each member draws its samples with replacement, once.
        num_members: Networks in the ensemble.
        key: Draws the bootstrap samples.
    """
    shape = (num_members, len(samples.episode))
    if config.bootstrap and num_members > 1:
        rows = jax.random.randint(key, shape, 0, samples.count)
    else:
        rows = jnp.broadcast_to(jnp.arange(shape[1]), shape)
    return FitData(episodes, samples, rows, statistics)
