"""A controller whose action was replaced by a safety layer or by an operator."""

from typing import ClassVar

import jax
import numpy as np
import pytest

import toys
from headway.config import CEMConfig, MultiHeadedConfig, PlannerConfig
from headway.errors import ConfigError
from headway.models.grbal import GrBAL, ReluNet
from headway.planning.agent import Agent
from headway.planning.controller import Controller
from headway.task import env_action, scaled_action

PLANNER = PlannerConfig(
    horizon=3,
    num_candidates=40,
    optimizer=CEMConfig(num_elites=5),
    num_iterations=2,
    num_particles=2,
    selection_length=3,
)
UP_DOWN = toys.linear_model([[np.eye(2), -np.eye(2)], [-np.eye(2), np.eye(2)]])
OBS = np.float32([0.8, -0.6])


class Valves(toys.PointTask):
    """The same point, pushed in other units."""

    action_low: ClassVar[tuple[float, ...]] = (-2.0, 0.0)
    action_high: ClassVar[tuple[float, ...]] = (2.0, 40.0)


TASK = Valves()


def make_controller(**options) -> Controller:
    statistics = toys.identity_statistics(TASK)
    return Controller(
        toys.make_agent(UP_DOWN, PLANNER, statistics=statistics, task=TASK), **options
    )


def mirror(action):
    """What an operator does who wants the opposite."""
    return env_action(TASK, -scaled_action(TASK, action))


@pytest.mark.parametrize(("told", "heads"), [(True, [0, 1]), (False, [1, 0])])
def test_heads_are_chosen_by_what_was_applied(told, heads):
    controller, obs, applied = make_controller(), OBS, None
    for _ in range(4):
        asked = controller.act(obs, applied_action=applied if told else None)
        applied = mirror(asked)
        obs = obs + scaled_action(TASK, applied)
    controller.act(obs, applied_action=applied if told else None)
    assert np.asarray(controller.heads).tolist() == heads
    newest = controller._state.belief.recent.action[0, -1]
    wanted = scaled_action(TASK, applied if told else asked)
    np.testing.assert_allclose(newest, wanted, atol=1e-6)
    assert np.abs(wanted).min() > 1e-3


def test_the_action_that_was_returned_is_the_one_that_counts_by_default():
    obs, plain, told = OBS, make_controller(), make_controller()
    action = None
    for _ in range(3):
        wanted = plain.act(obs)
        action = told.act(obs, applied_action=action)
        np.testing.assert_allclose(action, wanted, atol=1e-4)
        obs = obs + scaled_action(TASK, wanted)


def test_nothing_is_learned_from_a_step_whose_action_is_not_known():
    controller = make_controller()
    controller.act(OBS)
    controller.act(OBS, applied_action=np.array([0.0, np.nan]))
    assert int(controller._state.belief.recent.count[0]) == 0
    controller.act(OBS)
    assert int(controller._state.belief.recent.count[0]) == 1
    assert np.isfinite(np.asarray(controller._state.belief.recent.action)).all()


def test_a_model_that_adapts_learns_from_what_was_applied():
    config = MultiHeadedConfig(hidden_sizes=(4,), num_members=1, num_heads=1, deterministic=True)
    net = ReluNet.init(config, TASK, key=jax.random.key(0))
    model = GrBAL(net, toys.identity_statistics(TASK), TASK, 2, 0.1)
    controller = Controller(Agent(model, TASK, PLANNER))
    controller.act(OBS)
    controller.act(OBS, applied_action=[1.0, 10.0])
    np.testing.assert_allclose(controller._state.belief.action[0, -1], [0.5, -0.5], atol=1e-6)


@pytest.mark.parametrize(
    ("applied", "message"),
    [
        ([1.0], r"applied_action has shape \(1,\), allowed: \(2,\); pass one action in"),
        ([[0.0, 0.0]], r"applied_action has shape \(1, 2\)"),
        ("left", "applied_action is 'left', allowed: 2 numbers"),
        ([0.0, 44.1], r"applied_action\[1\] is 44.1, allowed: from 0 to 40, and 4 beyond"),
        ([-2.5, 0.0], r"applied_action\[0\] is -2.5, allowed: from -2 to 2"),
    ],
)
def test_what_cannot_be_an_action_is_an_error_and_changes_nothing(applied, message):
    controller = make_controller()
    controller.act(OBS)
    before = controller._state
    with pytest.raises(ConfigError, match=message) as caught:
        controller.act(OBS, applied_action=applied)
    assert "\n" not in str(caught.value)
    assert controller._state is before
    controller.act(OBS, applied_action=[2.3, -3.9])  # as a sensor may have it
    np.testing.assert_allclose(
        controller._state.belief.recent.action[0, -1], [1.15, -1.195], atol=1e-6
    )


def test_an_agent_that_remembers_no_actions_checks_them_all_the_same():
    controller = Controller(Agent(None, TASK, PLANNER))
    controller.act(OBS, applied_action=[0.0, 1.0])
    with pytest.raises(ConfigError, match="applied_action has shape"):
        controller.act(OBS, applied_action=[0.0])
