"""Fitting a model to the replay buffer: epochs on the device, one Adam step per batch.

Supplement A.2 and A.4; released `dynamics/tmcl.py`. Heads are assigned once per epoch over the
whole data set, then forward and backward losses are minimised in mini-batches.
"""

import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import optax
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray, UInt32

from headway.config import FittingConfig
from headway.data import Episodes, Samples, segment_sums
from headway.models.compilation import in_each_precision
from headway.models.losses import (
    Assignment,
    Batch,
    HeadLosses,
    assign_heads,
    head_losses,
    sum_of_squares,
    total_loss,
)
from headway.models.multi_headed import MultiHeadNet
from headway.models.ria import intervene, relation_gradient, relation_parts
from headway.models.statistics import Statistics
from headway.task import Task

ROUNDS = 32
"""Of a shuffle; each moves a number with probability one half."""


class FitState(eqx.Module):
    """Weights and Adam's moments, which persist over iterations."""

    model: Any
    optimizer: optax.OptState
    relation_optimizer: optax.OptState | None = None
    """Adam's moments for the relation loss, which has an Adam of its own (RIA)."""

    @classmethod
    def new(cls, model: Any) -> "FitState":
        """Start fitting a new model."""
        adam = optax.adam(0.0)  # moments do not depend on the rate
        if getattr(model, "relation_head", None) is None:
            return cls(model, adam.init(model))
        parts: Any = relation_parts(model)
        return cls(model, adam.init(model), adam.init(parts))

    def step(
        self, loss: Float[Array, ""], grads: Any, learning_rate: float, relation_grads: Any = None
    ) -> tuple["FitState", Bool[Array, ""]]:
        """Take one Adam step, unless the loss or the norm of the gradient is not finite.

        On a CPU it is a branch: choosing between old and new numbers costs as much as the step
        itself, for both are read and written again.

        Args:
            loss: The objective.
            grads: Its gradient, laid out as the model.
            learning_rate: Adam's.
            relation_grads: That of the relation loss, laid out as `RelationParts`, if there is one.

        Returns:
            The new state or the old one, and whether the step was skipped.
        """
        adam = optax.adam(learning_rate)

        def taken() -> FitState:
            changes, optimizer = adam.update(grads, self.optimizer)
            model = eqx.apply_updates(self.model, changes)
            if relation_grads is None:
                return FitState(model, optimizer)
            moments: Any = self.relation_optimizer
            changes, moments = adam.update(relation_grads, moments)
            parts: Any = eqx.apply_updates(relation_parts(model), changes)
            return FitState(eqx.tree_at(relation_parts, model, parts), optimizer, moments)

        leaves = jax.tree.leaves((grads, relation_grads))
        size = sum((sum_of_squares(leaf) for leaf in leaves), jnp.zeros(()))
        finite = jnp.isfinite(loss) & jnp.isfinite(size)
        if jax.default_backend() == "cpu":
            # In this order: with the branches exchanged XLA copies weights and moments.
            return jax.lax.cond(finite, taken, lambda: self), ~finite
        return jax.tree.map(functools.partial(jnp.where, finite), taken(), self), ~finite


class EpochStats(NamedTuple):
    """Averages over the updates of one epoch."""

    loss: Float[Array, ""]
    """The objective, over the updates that were taken."""
    forward_loss: Float[Array, ""]
    """The part of it that predicts forwards in time."""
    skipped: Int[Array, ""]
    """Updates that were not taken, because a number was not finite."""
    updates: Int[Array, ""]
    """All updates, skipped ones included."""


Update = tuple[FitState, Float[Array, ""], Float[Array, ""], Bool[Array, ""]]
"""The state after an update, its loss, the forward loss, and whether it was skipped."""


def run_updates(
    state: FitState,
    num_updates: int | Int[Array, ""],
    update: Callable[[Int[Array, ""], FitState], Update],
) -> tuple[FitState, EpochStats]:
    """Take the updates of an epoch, on the device."""

    def step(i, carry):
        state, loss, forward, skipped = carry
        state, one_loss, one_forward, bad = update(i, state)
        loss, forward = loss + jnp.where(bad, 0, one_loss), forward + jnp.where(bad, 0, one_forward)
        return state, loss, forward, skipped + bad

    start = state, jnp.zeros(()), jnp.zeros(()), jnp.zeros((), jnp.int32)
    state, loss, forward, skipped = jax.lax.fori_loop(0, num_updates, step, start)
    taken = jnp.maximum(num_updates - skipped, 1)
    updates = jnp.asarray(num_updates, jnp.int32)
    return state, EpochStats(loss / taken, forward / taken, skipped, updates)


class FitData(NamedTuple):
    """All that an epoch reads; stays on the device while fitting."""

    episodes: Episodes
    samples: Samples
    rows: Int[Array, "member sample"]
    statistics: Statistics


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


class FitSetup(eqx.Module):
    """Constants of the compiled epoch: the task and the settings."""

    task: Task
    config: FittingConfig = eqx.field(static=True)
    history_length: int = eqx.field(static=True)

    @property
    def segment_length(self) -> int:
        """M: transitions that share a best head; 1 for the transition-wise oracle."""
        return self.config.segment_length if self.config.oracle == "trajectory" else 1


def assign_segments(
    model: MultiHeadNet, setup: FitSetup, episodes: Episodes, statistics: Statistics
) -> Assignment:
    """Find the best head of every segment of every episode (paper, section 3).

    Each transition is predicted with its own context; forward and backward heads are chosen
    independently. Segments past an episode's end hold head 0 and are never used.

    Returns:
        Heads, [member, episode, segment].
    """
    members, steps = model.num_members, episodes.action.shape[1]
    num_segments = -(-steps // setup.segment_length)

    def assign_episode(episode, assignment: Assignment) -> Assignment:
        valid = jnp.arange(steps) < episodes.length[episode]
        losses = episode_losses(model, setup, episodes, episode, statistics)
        best = jax.tree.map(
            lambda loss: assign_heads(segment_sums(loss, valid, setup.segment_length)), losses
        )
        return jax.tree.map(
            lambda all_, one: all_.at[:, episode].set(one), assignment, Assignment(*best)
        )

    empty = jnp.zeros((members, len(episodes.length), num_segments), jnp.int32)
    start = Assignment(empty, None if model.backward_net is None else empty)
    return jax.lax.fori_loop(0, episodes.count, assign_episode, start)


def episode_losses(
    model: MultiHeadNet,
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
    outcome = episodes.outcome[episode]
    batch = Batch(obs[:-1], action, obs[1:], past, jnp.ones(len(action)), physics, row, outcome)
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
    """Fetch the samples of one update and their best heads."""
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
        outcome=episodes.outcome[episode, step],
    )
    if assignment is None:
        return batch, None
    member = jnp.arange(order.shape[0])[:, None]
    segment = anchor // setup.segment_length
    return batch, jax.tree.map(lambda heads: heads[member, episode, segment], assignment)


def update(
    state: FitState,
    setup: FitSetup,
    statistics: Statistics,
    batch: Batch,
    assignment: Assignment | None,
) -> Update:
    """Take one Adam step on a batch; a step with a non-finite loss or gradient is skipped."""
    config = setup.config

    def objective(model):
        losses = head_losses(model.in_precision(config.precision), setup.task, statistics, batch)
        loss, forward = total_loss(model, losses, assignment, batch.weight, config)
        if model.relation_head is None:
            return loss, (forward, None)
        pull, similar = intervene(model, setup.task, statistics, batch, config)
        return loss + pull, (forward, similar)

    (loss, (forward, similar)), grads = jax.value_and_grad(objective, has_aux=True)(state.model)
    relation_loss, relation_grads = jnp.zeros(()), None
    if similar is not None:
        # Both gradients are taken at the same weights, each with an Adam of its own.
        relation_loss, relation_grads = relation_gradient(
            state.model, statistics, batch, similar, config.weight_decay
        )
    rate = config.learning_rate
    state, skipped = state.step(loss + relation_loss, grads, rate, relation_grads)
    return state, loss, forward, skipped


def one_epoch(
    state: FitState, setup: FitSetup, data: FitData, *, independent: bool, key: PRNGKeyArray
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
    size, count = setup.config.batch_size, data.samples.count
    members, capacity = data.rows.shape
    order = permutations(key, (members, capacity), count)
    order = jnp.pad(order, ((0, 0), (0, -capacity % size)))

    def on_batch(i, state):
        chosen = jax.lax.dynamic_slice_in_dim(order, i * size, size, axis=1)
        weight = (i * size + jnp.arange(size) < count).astype(jnp.float32)
        weight = jnp.broadcast_to(weight, chosen.shape)
        batch, heads = gather_batch(data, assignment, chosen, weight, setup)
        return update(state, setup, data.statistics, batch, heads)

    return run_updates(state, -(-count // size), on_batch)


_COMPILED = in_each_precision(one_epoch)


@functools.wraps(one_epoch)
def fit_epoch(state: FitState, setup: FitSetup, *args: Any, **named: Any) -> Any:
    """`one_epoch`, compiled for the precision of the fit."""
    return _COMPILED[setup.config.precision](state, setup, *args, **named)


def permutations(
    key: PRNGKeyArray, shape: tuple[int, int], count: int | Int[Array, ""]
) -> Int[Array, "member sample"]:
    """An order of the numbers below `count` for each member; the others keep their place.

    The swap-or-not shuffle (Hoang, Morris and Rogaway, CRYPTO 2012) moves every number by itself:
    each round pairs the numbers below `count` at random and swaps each pair or not, by a coin that
    both of them compute. Sorting random draws took twenty times as long on a CPU
    (docs/performance.md).

    Args:
        key: Draws the orders.
        shape: Members, and numbers of each.
        count: How many of the numbers are put in a random order.
    """
    pivot_key, salt_key = jax.random.split(key)
    each_round = (ROUNDS, shape[0], 1)
    pivots = jax.random.randint(pivot_key, each_round, 0, jnp.maximum(count, 1))
    salts = jax.random.bits(salt_key, each_round, jnp.uint32)
    places = jnp.broadcast_to(jnp.arange(shape[1]), shape)

    def swap_or_not(order, drawn):
        pivot, salt = drawn
        partner = pivot - order
        partner = jnp.where(partner < 0, partner + count, partner)
        return jnp.where(_coin(jnp.maximum(order, partner), salt), partner, order), None

    order, _ = jax.lax.scan(swap_or_not, places, (pivots, salts))
    return jnp.where(places < count, order, places)


def _coin(number: Int[Array, "*shape"], salt: UInt32[Array, "*#shape"]) -> Array:
    """A fair coin for every number: the first bit of MurmurHash3's final mix."""
    bits = number.astype(jnp.uint32) ^ salt
    bits = (bits ^ (bits >> 16)) * jnp.uint32(0x85EBCA6B)
    bits = (bits ^ (bits >> 13)) * jnp.uint32(0xC2B2AE35)
    return bits >> 31 == 1
