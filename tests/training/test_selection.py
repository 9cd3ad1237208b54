"""Head selection and calibration, measured on episodes and on numbers made by hand."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import toys
from headway.data import History, Trajectory
from headway.models.statistics import Statistics, network_input
from headway.training.selection import EpisodeSelection, examine, summarise

TINY = dataclasses.replace(toys.TINY, selection_length=3)


def make_agent(net, statistics=None):
    return toys.make_agent(net, TINY, statistics=statistics or toys.odd_statistics())


def by_hand(errors, chosen, deviations=None):
    """An episode from plain lists: errors [step][head] and choices [step] of a single member."""
    errors, chosen = np.array(errors, float)[:, None], np.array(chosen)[:, None]
    return EpisodeSelection({"gain": 1.0}, errors, chosen, deviations)


def test_it_examines_what_the_acting_agent_decided():
    """The agent's own choices, step by step, and its heads' errors on what followed."""
    agent = make_agent(toys.small_model())
    state = agent.init(1, key=jax.random.key(3))
    obs, actions, heads = [np.float32([0.3, -0.2])], [], []
    for _ in range(9):
        state, decision = agent.act(state, obs[-1][None])
        actions.append(np.asarray(decision.action[0]))
        heads.append(np.asarray(decision.heads[0]))
        obs.append(obs[-1] + np.float32([0.7, 1.2]) * actions[-1])
    trajectory = Trajectory(np.stack(obs), np.stack(actions), np.zeros(9), {"gain": 1.0})
    longer = toys.random_trajectory(14, seed=3)
    found, _ = examine(agent.model, [trajectory, longer], key=jax.random.key(1))
    np.testing.assert_array_equal(found.chosen, np.stack(heads)[1:])
    assert found.errors.shape == (8, 2, 2)
    assert len(set(map(tuple, found.chosen))) > 1

    # The error of the last step, from the model itself.
    past = slice(5, 8)  # three transitions are remembered
    history = jax.tree.map(
        lambda x: jnp.broadcast_to(jnp.asarray(x), (2, 1, *x.shape)),
        (np.diff(trajectory.obs[5:9], axis=0), trajectory.action[past]),
    )
    statistics = agent.model.statistics
    context = agent.model.net.context(History(*history), statistics)
    last = trajectory.obs[8:9], trajectory.action[8:9]
    x = network_input(toys.POINT, statistics, *map(jnp.asarray, last))
    wide = jnp.broadcast_to(x, (2, *x.shape))
    prediction = toys.predict(agent.model.net.forward_net, wide, context)
    delta = statistics.delta.normalize(jnp.asarray(np.diff(trajectory.obs[8:], axis=0)))
    difference = np.asarray(delta - prediction.mean)[:, :, 0]
    np.testing.assert_allclose(found.errors[-1], np.square(difference).mean(-1), rtol=1e-4)
    chosen = [difference[m, found.chosen[-1, m]] for m in range(2)]
    std = np.exp(0.5 * np.asarray(prediction.logvar)[:, :, 0])
    scaled = [chosen[m] / std[m, found.chosen[-1, m]] for m in range(2)]
    np.testing.assert_allclose(found.deviations[-1], scaled, rtol=1e-4)


def test_a_perfect_head_is_found_and_costs_nothing():
    model = toys.linear_model([[np.eye(2), -np.eye(2)], [-np.eye(2), np.eye(2)]])
    agent = make_agent(model, toys.identity_statistics())
    episodes = [toys.random_trajectory(12, seed=s, gain=g) for s, g in enumerate((1.0, -1.0, 1.0))]
    found = examine(agent.model, episodes, key=jax.random.key(0))
    np.testing.assert_array_equal([e.best for e in found], [[0, 1], [1, 0], [0, 1]])
    summary = summarise(found)
    assert summary.wrong_selections == 0
    assert summary.chosen_error == pytest.approx(0, abs=1e-9)
    assert summary.regret == pytest.approx(0, abs=1e-9)
    assert summary.average_error > 0.1
    assert summary.calibration is None


def test_regret_and_wrong_selections_by_hand():
    # Head 1 is best in hindsight (errors 1+1+1+1 against 0+4+4+4).
    episode = by_hand([[0, 1], [4, 1], [4, 1], [4, 1]], [0, 0, 1, 1])
    np.testing.assert_array_equal(episode.best, [1])
    summary = summarise([episode])
    assert summary.best_error == 1
    assert summary.chosen_error == (0 + 4 + 1 + 1) / 4
    assert summary.regret == pytest.approx(0.5)
    assert summary.average_error == (0.5 + 2.5 + 2.5 + 2.5) / 4
    assert summary.wrong_selections == 0.5
    np.testing.assert_array_equal(summary.head_errors, [[3, 1]])


def test_switching_can_beat_every_single_head():
    summary = summarise([by_hand([[0, 2], [2, 0]], [0, 1])])
    assert summary.regret == -1


@pytest.mark.parametrize("spread", [1.0, 2.0])
def test_calibration(spread):
    deviations = spread * np.random.default_rng(0).normal(size=(4000, 1, 3))
    episode = EpisodeSelection({}, np.zeros((4000, 1, 1)), np.zeros((4000, 1), int), deviations)
    calibration = summarise([episode]).calibration
    assert calibration.mean_square == pytest.approx(spread**2, rel=0.03)
    for level, inside in calibration.inside.items():
        if spread == 1:
            assert inside == pytest.approx(level, abs=0.01)
        else:
            assert inside < level - 0.1


def test_dimensions_that_never_vary_are_not_calibrated():
    trajectory = toys.random_trajectory(8, constant=True)
    statistics = Statistics.fit(toys.POINT, [trajectory], 3)
    agent = make_agent(toys.small_model(), statistics)
    (found,) = examine(agent.model, [trajectory], key=jax.random.key(0))
    assert found.deviations.shape == (7, 2, 1)


def test_an_episode_of_one_transition_has_nothing_to_examine():
    agent = make_agent(toys.small_model())
    assert examine(agent.model, [toys.random_trajectory(1)], key=jax.random.key(0)) == []
