"""The cost of a plan, counted by hand."""

import dataclasses

import pytest

import toys
from headway.config import (
    CEMConfig,
    ICEMConfig,
    MPPIConfig,
    MultiHeadedConfig,
    PlannerConfig,
    RandomShootingConfig,
)
from headway.planning.flop import plan_flop
from headway.task import env_spec

MODEL = MultiHeadedConfig(hidden_sizes=(8, 6), num_heads=3)
PLANNER = PlannerConfig(
    horizon=5,
    num_candidates=40,
    optimizer=CEMConfig(num_elites=8),
    num_iterations=3,
    num_particles=10,
)
PER_STEP = 2 * (4 * 8 + 8 * 6 + 6 * 4)  # two observations and two actions; mean and variance


def test_the_papers_half_cheetah():
    task = env_spec("half-cheetah").make_task()
    assert plan_flop(MultiHeadedConfig(), PlannerConfig(), task) == pytest.approx(158.4e9)


def test_a_step_of_each_kind_of_heads():
    def step_flop(model, planner, task):
        return plan_flop(model, planner, task, evaluations=1.0) / (10 * 5)

    assert step_flop(MODEL, PLANNER, toys.POINT) == PER_STEP
    deterministic = dataclasses.replace(MODEL, deterministic=True)
    assert step_flop(deterministic, PLANNER, toys.POINT) == PER_STEP - 2 * 6 * 2
    average = dataclasses.replace(PLANNER, head_selection="average")
    assert step_flop(MODEL, average, toys.POINT) == PER_STEP + 2 * 6 * 2 * 2


@pytest.mark.parametrize(
    ("optimizer", "evaluations"),
    [
        (CEMConfig(num_elites=8), 120),
        (MPPIConfig(), 120),
        (RandomShootingConfig(), 120),
        (ICEMConfig(num_elites=8), 40 + 32 + 25 + 3 * 2 + 1),
    ],
)
def test_a_plan_of_each_optimizer(optimizer, evaluations):
    planner = dataclasses.replace(PLANNER, optimizer=optimizer)
    assert plan_flop(MODEL, planner, toys.POINT) == evaluations * 10 * 5 * PER_STEP


def test_what_was_really_evaluated_counts_if_it_is_known():
    assert plan_flop(MODEL, PLANNER, toys.POINT, 55.5) == 55.5 * 10 * 5 * PER_STEP
