"""Fitting block by block: every sample once, two blocks at most, one block as it always was."""

import dataclasses
import gc
import itertools
import threading
import time
import weakref

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import toys
from headway.config import CollectionConfig, Config, FittingConfig, ModelConfig
from headway.data import Episodes, Samples
from headway.experiment.blocks import BlockedData, Layout, fit_blocks, made_ahead, merge_stats
from headway.experiment.diagnostics import head_shares
from headway.experiment.methods import make_config
from headway.models import fitting
from headway.models.dynamics import MultiHeadDynamics, Statistics
from headway.models.fitting import FitSetup, fit_epoch, make_data
from headway.models.updates import EpochStats
from headway.planning.agent import Agent
from headway.tasks.catalog import env_names, env_spec

LENGTHS = [9, 4, 1, 9, 7, 2, 9]
TRAJECTORIES = [toys.random_trajectory(n, seed=i) for i, n in enumerate(LENGTHS)]
PLAIN = ModelConfig(
    num_members=2, num_heads=2, hidden_sizes=(8,), context_size=0, backward_net=False
)
KEY, OTHER = jax.random.key(1), jax.random.key(2)


def blocked(num_episodes, trajectories=TRAJECTORIES, **settings):
    """Data in blocks of some episodes of up to nine steps."""
    settings = {"segment_length": 3, "batch_size": 8, "future_length": 2} | settings
    setup = FitSetup(toys.POINT, FittingConfig(**settings), 3)
    statistics = Statistics.fit(toys.POINT, trajectories, 3)
    return BlockedData(trajectories, Layout(num_episodes, 9), statistics, setup, 2, OTHER)


def new_state(data, config=PLAIN):
    return data.setup.init(MultiHeadDynamics.init(config, toys.POINT, key=jax.random.key(0)))


def fit(data, epochs, *, independent=False):
    """Fit as the Trainer does."""
    state, history = new_state(data), []
    stream = data.stream(epochs, KEY)
    for _ in range(epochs):
        blocks = itertools.islice(stream, data.num_blocks)
        state, stats = fit_blocks(state, data.setup, blocks, independent=independent)
        history.append(stats)
    assert next(stream, None) is None
    return state, history


def contents(block, *, drawn=False):
    """The samples of a block: action and offset tell which; `drawn` follows member 0's rows."""
    samples, count = block.data.samples, int(block.data.samples.count)
    rows = block.data.rows[0, :count] if drawn else np.arange(count)
    action = np.asarray(block.data.episodes.action)[samples.episode[rows], samples.anchor[rows]]
    return [(*pair, int(f)) for pair, f in zip(action.tolist(), samples.offset[rows], strict=True)]


def all_samples():
    return sorted(
        (*trajectory.action[anchor].tolist(), offset)
        for trajectory in TRAJECTORIES
        for anchor in range(len(trajectory))
        for offset in range(min(2, len(trajectory) - anchor))
    )


def trees_equal(first, second):
    pairs = zip(jax.tree.leaves(first), jax.tree.leaves(second), strict=True)
    return all(np.array_equal(a, b) for a, b in pairs)


@pytest.mark.parametrize("bootstrap", [False, True])
def test_one_block_is_the_algorithm_over_all_data_to_the_bit(bootstrap):
    data = blocked(8, bootstrap=bootstrap)
    got, history = fit(data, 3)
    samples = Samples.table(LENGTHS, 2, capacity=8 * 9 * 2)
    episodes = Episodes.pad(TRAJECTORIES, 8, 9)
    config = data.setup.config
    whole = make_data(episodes, samples, data.statistics, config, num_members=2, key=OTHER)
    state = new_state(data)
    for epoch in range(3):
        key = jax.random.fold_in(KEY, epoch)
        state, stats = fit_epoch(state, data.setup, whole, independent=False, key=key)
        assert float(history[epoch].loss) == float(stats.loss)
        assert float(history[epoch].forward_loss) == float(stats.forward_loss)
        assert int(history[epoch].updates) == int(stats.updates)
    assert trees_equal(got, state)


@pytest.mark.parametrize("num_episodes", [1, 2, 3, 6])
def test_the_blocks_of_an_epoch_hold_every_sample_once_in_arrays_of_one_shape(num_episodes):
    data = blocked(num_episodes)
    assert data.num_blocks == -(-7 // num_episodes)
    blocks = list(data.stream(2, KEY))
    assert len(blocks) == 2 * data.num_blocks
    for epoch in (blocks[: data.num_blocks], blocks[data.num_blocks :]):
        assert sorted(sample for block in epoch for sample in contents(block)) == all_samples()
        counts = [int(block.data.episodes.count) for block in epoch]
        assert max(counts) <= num_episodes
        assert max(counts) - min(counts) <= 1
    shapes = {str(jax.tree.map(jnp.shape, block.data)) for block in blocks}
    assert len(shapes) == 1


def test_updates_see_every_sample_of_every_block_once(monkeypatch):
    seen = []
    gather = fitting.gather_batch

    def spying(data, assignment, order, weight, setup):
        batch, owners = gather(data, assignment, order, weight, setup)
        jax.debug.callback(lambda *x: seen.append(x), batch.obs, batch.action, weight)
        return batch, owners

    monkeypatch.setattr(fitting, "gather_batch", spying)
    data = blocked(3, epochs=1003)  # settings no other test compiled
    _, (stats,) = fit(data, 1, independent=True)
    jax.effects_barrier()
    assert len(seen) == int(stats.updates)
    assert int(stats.updates) >= -(-len(all_samples()) // 8)
    wanted = sorted(
        trajectory.obs[anchor + offset].tolist()
        for trajectory in TRAJECTORIES
        for anchor in range(len(trajectory))
        for offset in range(min(2, len(trajectory) - anchor))
    )
    for member in range(2):
        obs = np.concatenate([obs[member][weight[member] > 0] for obs, _, weight in seen])
        assert sorted(obs.tolist()) == wanted


@pytest.mark.parametrize("num_episodes", [2, 7])
def test_a_stream_goes_on_at_any_epoch(num_episodes):
    data = blocked(num_episodes)
    whole = list(data.stream(3, KEY))
    for first in range(4):
        rest = list(data.stream(3, KEY, first=first))
        wanted = whole[first * data.num_blocks :]
        assert len(rest) == len(wanted)
        for one, other in zip(rest, wanted, strict=True):
            assert trees_equal(one.data, other.data)
            assert jax.random.key_data(one.key).tolist() == jax.random.key_data(other.key).tolist()


def test_episodes_are_dealt_anew_in_every_epoch_and_the_same_for_the_same_key():
    data = blocked(2)
    first, again = list(data.stream(2, KEY)), list(data.stream(2, KEY))
    other = list(data.stream(2, OTHER))
    assert all(trees_equal(a.data, b.data) for a, b in zip(first, again, strict=True))
    keys = [tuple(jax.random.key_data(block.key).tolist()) for block in first]
    assert len(set(keys)) == len(keys)
    assert not all(trees_equal(a.data, b.data) for a, b in zip(first[:4], first[4:], strict=True))
    assert not all(trees_equal(a.data, b.data) for a, b in zip(first, other, strict=True))


def test_bootstrap_in_blocks_draws_once_per_fit_within_each_episode():
    data = blocked(2, bootstrap=True)
    blocks = list(data.stream(2, KEY))
    first, second = blocks[: data.num_blocks], blocks[data.num_blocks :]
    drawn = [
        sorted(sample for block in epoch for sample in contents(block, drawn=True))
        for epoch in (first, second)
    ]
    assert drawn[0] == drawn[1]  # however the episodes were dealt
    assert set(drawn[0]) < set(all_samples())  # with replacement
    for block in first:
        rows, episode = np.asarray(block.data.rows), np.asarray(block.data.samples.episode)
        count = int(block.data.samples.count)
        assert (episode[rows[:, :count]] == episode[:count]).all()
        assert (rows[:, :count] < count).all()
    assert any((block.data.rows[0] != block.data.rows[1]).any() for block in blocks)
    other = list(dataclasses.replace(data, key=KEY).stream(1, KEY))
    assert drawn[0] != sorted(s for block in other for s in contents(block, drawn=True))


def test_fitting_in_blocks_lowers_the_loss_about_as_much_as_in_one_block():
    trajectories = [toys.random_trajectory(9, seed=i) for i in range(24)]
    losses = {}
    for num_episodes in (24, 5):
        data = blocked(num_episodes, trajectories, learning_rate=1e-2, weight_decay=0.0)
        losses[num_episodes] = [float(stats.loss) for stats in fit(data, 12)[1]]
    drop = {n: found[0] - found[-1] for n, found in losses.items()}
    assert drop[24] > 1.0
    assert drop[5] > 0.8 * drop[24]


def test_blocks_are_traced_once_however_episodes_are_dealt(monkeypatch):
    traces = []
    original = fitting.shuffle
    monkeypatch.setattr(fitting, "shuffle", lambda *args: traces.append(1) or original(*args))
    fit(blocked(2, epochs=1004), 2)  # settings no other test compiled
    assert len(traces) == 1


def test_merged_stats_are_averages_over_the_updates_that_were_taken():
    parts = [
        EpochStats(*map(np.asarray, part))
        for part in [(2.0, 1.0, 1, 3), (0.0, 0.0, 4, 4), (5.0, 7.0, 0, 1)]
    ]
    merged = merge_stats(parts)
    assert tuple(map(float, merged)) == (3.0, 3.0, 5.0, 8.0)
    assert tuple(map(float, merge_stats(parts[1:2]))) == (0.0, 0.0, 4.0, 4.0)
    odd = EpochStats(np.float32(0.1), np.float32(1 / 3), np.int32(0), np.int32(977))
    assert tuple(map(float, merge_stats([odd]))) == tuple(map(float, odd))


class Thing:
    """Counts how many of its kind are alive."""

    alive: weakref.WeakSet

    def __init__(self, number):
        self.number = number
        Thing.alive.add(self)
        Thing.most = max(Thing.most, len(Thing.alive))


def test_at_most_two_results_exist_and_they_come_in_order():
    Thing.alive, Thing.most = weakref.WeakSet(), 0
    numbers = []
    gc.disable()
    try:
        for thing in made_ahead(Thing, range(20)):
            numbers.append(thing.number)
            time.sleep(0.01)  # more than enough to make another, and one too many
            del thing
    finally:
        gc.enable()
    assert numbers == list(range(20))
    assert Thing.most == 2
    assert list(made_ahead(Thing, [])) == []


def test_the_next_result_is_made_while_this_one_is_used():
    made = [threading.Event() for _ in range(3)]
    stream = made_ahead(lambda i: made[i].set() or i, range(3))
    assert next(stream) == 0
    assert made[1].wait(10)
    assert not made[2].is_set()
    stream.close()


def test_an_error_in_the_background_reaches_the_caller():
    stream = made_ahead(lambda x: 1 // x, [1, 0, 1])
    assert next(stream) == 1
    with pytest.raises(ZeroDivisionError):
        next(stream)


@pytest.mark.parametrize("env", env_names())
def test_the_papers_data_are_one_block(env):
    config = make_config(env)
    length = env_spec(env).episode_length
    assert Layout.of(config, length)[:2] == (100, length)


def test_padding_counts_towards_the_size_of_a_block():
    config = Config(
        env="pendulum",
        collection=CollectionConfig(num_iterations=10, num_episodes=10),
        fitting=FittingConfig(block_transitions=4100),
    )
    assert Layout.of(config, 1000)[:2] == (4, 1000)
    assert Layout.of(config, 41)[:2] == (100, 41)
    assert Layout.of(config, 42)[:2] == (97, 42)


def test_head_shares_by_blocks_are_those_of_all_data():
    data = blocked(3)
    trajectories = [
        dataclasses.replace(t, sim_params={"gain": float(i % 2)})
        for i, t in enumerate(TRAJECTORIES)
    ]
    model = toys.small_model(config=PLAIN)
    agent = Agent(model, data.statistics, toys.POINT, Config(env="pendulum").planner, 3)
    whole, parts = (
        head_shares(agent, data.setup, Layout(n, 9).in_order(trajectories)) for n in (7, 3)
    )
    assert whole == parts
    assert 0 < whole[0]["share"] < 1
