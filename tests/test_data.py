"""Trajectories and the views of them that a model is fitted to, against NumPy twins."""

import jax.numpy as jnp
import jaxtyping
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import toys
from headway.data import (
    Episodes,
    Samples,
    Trajectory,
    history_action_moments,
    segment_sums,
)
from headway.errors import BadEnvironmentError, ConfigError

RAGGED = [1, 7, 3, 12]
lengths_lists = st.lists(st.integers(1, 30), min_size=1, max_size=4)


def twin_history(trajectory, step, length):
    """Slot j holds step j at first, later a shifting window; unused slots are zero."""
    obs_diff = np.zeros((length, trajectory.obs.shape[1]), np.float32)
    action = np.zeros((length, trajectory.action.shape[1]), np.float32)
    past = range(max(step - length, 0), step)
    for slot, i in enumerate(past):
        obs_diff[slot] = trajectory.obs[i + 1] - trajectory.obs[i]
        action[slot] = trajectory.action[i]
    return obs_diff, action


@pytest.mark.parametrize("length", [1, 3, 10, 20])  # 20 are more than an episode has
def test_history_at_every_step_of_ragged_episodes_equals_its_numpy_twin(length):
    trajectories = [toys.random_trajectory(n, seed=n) for n in RAGGED]
    episodes = Episodes.pad(trajectories, capacity=5, max_length=14)
    where = [(row, step) for row, n in enumerate(RAGGED) for step in range(n)]
    got = episodes.history(*map(jnp.asarray, zip(*where, strict=True)), length)
    for i, (row, step) in enumerate(where):
        obs_diff, action = twin_history(trajectories[row], step, length)
        np.testing.assert_array_equal(got.obs_diff[i], obs_diff)
        np.testing.assert_array_equal(got.action[i], action)


@pytest.mark.parametrize("length", [1, 4, 10])
def test_history_action_moments_count_the_zeros_of_the_first_steps(length):
    trajectories = [toys.random_trajectory(n, seed=n) for n in RAGGED]
    rows = [twin_history(t, step, length)[1] for t in trajectories for step in range(len(t))]
    mean, std = history_action_moments(trajectories, length)
    np.testing.assert_allclose(mean, np.mean(rows, axis=0, dtype=np.float64), atol=1e-7)
    np.testing.assert_allclose(std, np.std(np.float64(rows), axis=0), atol=1e-6)
    assert mean.shape == std.shape == (length, 2)


@given(lengths_lists, st.integers(1, 6), st.booleans())
def test_sample_table_lists_every_anchor_and_offset_inside_its_episode_once(
    lengths, future, drop_first
):
    expected = {
        (episode, anchor, offset)
        for episode, length in enumerate(lengths)
        for anchor in range(int(drop_first), length)
        for offset in range(future)
        if anchor + offset < length
    }
    samples = Samples.table(lengths, future, len(expected) + 2, drop_first=drop_first)
    count = int(samples.count)
    assert count == len(expected)
    rows = np.stack([samples.episode, samples.anchor, samples.offset], axis=-1)
    assert {tuple(row) for row in rows[:count].tolist()} == expected
    assert not rows[count:].any()


@pytest.mark.parametrize("transitions", [5, 12, 200])
def test_sample_counts_follow_the_closed_formula(transitions):
    capacity = 5 * transitions
    whole = Samples.table([transitions], 5, capacity)
    dropped = Samples.table([transitions], 5, capacity, drop_first=True)
    assert int(whole.count) == 5 * transitions - 10
    assert int(dropped.count) == 5 * transitions - 15  # the released code's count, with T - 1


@given(st.integers(1, 25), st.integers(1, 8), st.integers(0, 25), st.integers(0, 1000))
def test_segment_sums_equal_their_numpy_twin(steps, segment, num_valid, seed):
    values = np.random.default_rng(seed).normal(size=(2, steps)).astype(np.float32)
    valid = np.arange(steps) < num_valid
    starts = range(0, steps, segment)
    twin = [[row[s : s + segment][valid[s : s + segment]].sum() for s in starts] for row in values]
    got = segment_sums(jnp.asarray(values), jnp.asarray(valid), segment)
    np.testing.assert_allclose(got, twin, rtol=1e-5, atol=1e-5)


def test_padding_keeps_each_episode_and_repeats_its_last_observation():
    trajectories = [toys.random_trajectory(n, seed=n) for n in (2, 5)]
    episodes = Episodes.pad(trajectories, capacity=4, max_length=6)
    assert episodes.obs.shape == (4, 7, 2)
    assert episodes.action.shape == (4, 6, 2)
    np.testing.assert_array_equal(episodes.length, [2, 5, 0, 0])
    assert int(episodes.count) == 2
    for row, trajectory in enumerate(trajectories):
        steps = len(trajectory)
        np.testing.assert_array_equal(episodes.obs[row, : steps + 1], trajectory.obs)
        np.testing.assert_array_equal(episodes.action[row, :steps], trajectory.action)
        assert (np.asarray(episodes.obs[row, steps:]) == trajectory.obs[-1]).all()
        assert not np.asarray(episodes.action[row, steps:]).any()


@pytest.fixture
def unchecked_shapes():
    """What users run: without the shape checks of the tests."""
    jaxtyping.config.update("jaxtyping_disable", True)
    yield
    jaxtyping.config.update("jaxtyping_disable", False)


@pytest.mark.usefixtures("unchecked_shapes")
@pytest.mark.parametrize("shapes", [(3, 3, 3), (4, 3, 2), (1, 0, 0)])
def test_a_trajectory_of_mismatched_lengths_is_refused(shapes):
    obs, action, reward = shapes
    with pytest.raises(ConfigError, match=f"{obs} observations, {action} actions and {reward}"):
        Trajectory(np.zeros((obs, 2)), np.zeros((action, 1)), np.zeros(reward), {})


@pytest.mark.parametrize("name", ["obs", "action", "reward"])
def test_a_non_finite_number_in_a_trajectory_is_named_with_its_step_and_physics(name):
    arrays = {"obs": np.zeros((4, 2)), "action": np.zeros((3, 1)), "reward": np.zeros(3)}
    arrays[name][2] = np.nan
    with pytest.raises(BadEnvironmentError, match=f"{name} at step 2 is not finite.*length.*0.5"):
        Trajectory(**arrays, sim_params={"length": 0.5})


def test_returns_are_the_undiscounted_sum_of_rewards():
    trajectory = Trajectory(np.zeros((4, 1)), np.zeros((3, 1)), np.array([1.0, 2.0, 4.0]), {})
    assert trajectory.returns == 7.0
    assert len(trajectory) == 3
