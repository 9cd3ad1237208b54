"""Relational intervention against plain NumPy loops over pairs of contexts."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import toys
from headway.config import FittingConfig
from headway.data import History
from headway.models.fitting import FitState, fit_epoch, gather_batch, update
from headway.models.losses import HIDDEN_DECAY, Batch
from headway.models.multi_headed import MultiHeadNet
from headway.models.ria import (
    intervene,
    intervention_distance,
    relation_decay_loss,
    relation_gradient,
    relation_parts,
)
from headway.models.statistics import network_input

RIA = dataclasses.replace(toys.SMALL, num_heads=1, context_at="last-hidden", relation_head=True)
CONFIG = FittingConfig(relation_temperature=0.7, backward_weight=0.3, relation_distance_weight=1.5)
STATISTICS = toys.odd_statistics()
SAMPLES = 5


def random_batch(seed=0, weight=(1, 1, 1, 1, 0)):
    rng = np.random.default_rng(seed)
    draw = lambda *shape: jnp.asarray(rng.normal(size=shape), jnp.float32)  # noqa: E731
    two = (2, SAMPLES, 2)
    past = History(draw(2, SAMPLES, 3, 2), draw(2, SAMPLES, 3, 2))
    rows = jnp.asarray([[0, 0, 1, 1, 1], [0, 1, 2, 0, 2]])
    used = jnp.broadcast_to(jnp.asarray(weight, jnp.float32), (2, SAMPLES))
    return Batch(draw(*two), draw(*two), draw(*two), past, used, None, rows)


def distances_twin(model, batch, states):
    """Mean absolute difference of the predictions with two contexts, [direction, member, i, j]."""
    context = model.context(batch.history, STATISTICS)
    found = np.zeros((2, 2, SAMPLES, SAMPLES))
    for direction, (net, obs) in enumerate(
        [(model.forward_net, batch.obs), (model.backward_net, batch.next_obs)]
    ):
        x = network_input(toys.POINT, STATISTICS, obs, batch.action)
        means = np.zeros((2, len(states), SAMPLES, 2))
        for row, state in enumerate(states):
            same_state = jnp.repeat(x[:, state : state + 1], SAMPLES, axis=1)
            means[:, row] = toys.predict(net, same_state, context).mean[:, 0]
        for m, i, j in np.ndindex(2, SAMPLES, SAMPLES):
            found[direction, m, i, j] = np.abs(means[m, :, i] - means[m, :, j]).mean()
    return found


def losses_twin(model, batch, states):
    """Pull, similarity and relation loss, pair by pair."""
    context = np.asarray(model.context(batch.history, STATISTICS), np.float64)
    forward, backward = distances_twin(model, batch, states)
    used = np.flatnonzero(np.asarray(batch.weight[0]))
    rows, head = np.asarray(batch.trajectory), toys.f64(model.relation_head)
    pull = relation = 0.0
    similar = np.zeros((2, SAMPLES, SAMPLES))
    for m in range(2):
        pairs = [(i, j) for i in used for j in used]
        distance = (forward[m] + backward[m]) / 2
        std = np.std([distance[pair] for pair in pairs])
        similar[m] = np.exp(-distance / (std + 1e-6) / CONFIG.relation_temperature)
        for i, j in pairs:
            y, w = float(rows[m, i] == rows[m, j]), similar[m, i, j]
            pull += (forward[m, i, j] + 0.3 * backward[m, i, j]) * y / len(pairs)
            score = np.concatenate([context[m, i], context[m, j]]) @ head.weight[m, :, 0]
            p = toys.sigmoid(score + head.bias[m, 0])
            loss = -(y + w * (1 - y)) * np.log(p) - (1 - y) * (1 - w) * np.log(1 - p)
            relation += loss / len(pairs)
    return 1.5 * pull, similar, relation


@pytest.mark.parametrize("transitions", [0, 2])
def test_losses_and_weights_equal_a_loop_over_pairs(transitions):
    model, batch = toys.small_model(config=RIA), random_batch()
    config = dataclasses.replace(CONFIG, relation_transitions=transitions)
    pull, similar = eqx.filter_jit(intervene)(model, toys.POINT, STATISTICS, batch, config)
    relation, _ = relation_gradient(model, STATISTICS, batch, similar, 0.0)
    expected = losses_twin(model, batch, states=range(transitions or 4))
    np.testing.assert_allclose(pull, expected[0], rtol=1e-4)
    np.testing.assert_allclose(similar[:, :4, :4], expected[1][:, :4, :4], rtol=1e-3, atol=1e-5)
    np.testing.assert_allclose(relation, expected[2], rtol=1e-4)


@pytest.mark.parametrize("place", ["input", "last-hidden", "head"])
def test_contexts_are_compared_right_wherever_they_join(place):
    config = dataclasses.replace(RIA, context_at=place, hidden_sizes=(8, 7, 6))
    model, batch = toys.small_model(config=config), random_batch(weight=[1] * SAMPLES)
    context = model.context(batch.history, STATISTICS)
    x = network_input(toys.POINT, STATISTICS, batch.obs, batch.action)
    got = intervention_distance(model.forward_net, x, batch.weight, context)
    expected = distances_twin(model, batch, range(SAMPLES))[0]
    np.testing.assert_allclose(got, expected, rtol=1e-4, atol=1e-5)


def test_weight_decay_averages_the_encoders_layers():
    model = toys.small_model(config=RIA)
    encoder, head = model.context_encoder, model.relation_head
    squares = [float(np.square(layer.weight).sum()) for layer in (*encoder.hidden, encoder.output)]
    mean = np.mean([c / 2 * s for c, s in zip(HIDDEN_DECAY, squares, strict=False)])
    of_head = HIDDEN_DECAY[0] / 2 * float(np.square(head.weight).sum())
    got = relation_decay_loss(relation_parts(model))
    np.testing.assert_allclose(got, mean + of_head, rtol=1e-5)


def first_update():
    """A new model, and what its first update reads."""
    setup = toys.make_setup(batch_size=8)
    trajectories = [toys.random_trajectory(6, seed=n) for n in range(3)]
    data = toys.fit_data(trajectories, setup, future_length=2)
    model = MultiHeadNet.init(RIA, toys.POINT, key=jax.random.key(0))
    order = jnp.broadcast_to(jnp.arange(8), (2, 8))
    batch, _ = gather_batch(data, None, order, jnp.ones((2, 8)), setup)
    return model, setup, data, batch


def test_the_relation_loss_has_an_adam_of_its_own_and_starts_from_the_same_weights():
    model, setup, data, batch = first_update()
    state = FitState.new(model)
    both, *_ = eqx.filter_jit(update)(state, setup, data.statistics, batch, None)
    # Adam's first step has the size of the learning rate in every weight that has a gradient.
    moved = jax.tree.map(lambda a, b: np.abs(np.asarray(a - b)), both.model, model)
    np.testing.assert_allclose(moved.forward_net.hidden[0].weight.max(), 1e-3, rtol=1e-2)
    np.testing.assert_allclose(moved.relation_head.weight.max(), 1e-3, rtol=1e-2)
    np.testing.assert_allclose(moved.context_encoder.output.weight.max(), 2e-3, rtol=1e-2)
    assert moved.context_encoder.output.weight.min() < 1e-3


def test_nothing_is_learned_where_only_the_relation_loss_is_not_finite():
    model, setup, data, batch = first_update()
    huge = jnp.full_like(model.relation_head.weight, 3e38)
    state = FitState.new(eqx.tree_at(lambda model: model.relation_head.weight, model, huge))
    after, _, _, skipped = eqx.filter_jit(update)(state, setup, data.statistics, batch, None)
    assert bool(skipped)
    toys.assert_equal(after, state)


def test_the_relation_is_learned_and_contexts_of_one_trajectory_come_together():
    trajectories = [toys.random_trajectory(12, seed=n, gain=g) for n, g in enumerate((1, -1) * 3)]
    setup = toys.make_setup(batch_size=32, learning_rate=3e-3, relation_distance_weight=20.0)
    data = toys.fit_data(trajectories, setup, future_length=2)
    state = FitState.new(MultiHeadNet.init(RIA, toys.POINT, key=jax.random.key(0)))
    order = jnp.asarray(np.random.default_rng(0).integers(0, int(data.samples.count), (2, 32)))
    batch, _ = gather_batch(data, None, order, jnp.ones((2, 32)), setup)

    @jax.jit
    def measure(model):
        pull, similar = intervene(model, toys.POINT, data.statistics, batch, setup.config)
        return pull, relation_gradient(model, data.statistics, batch, similar, 0.0)[0]

    before = measure(state.model)
    for epoch in range(10):
        key = jax.random.key(epoch)
        state, stats = fit_epoch(state, setup, data, independent=True, key=key)
        assert int(stats.skipped) == 0
    after = measure(state.model)
    assert after[0] < 0.5 * before[0]
    assert after[1] < 0.95 * before[1]
