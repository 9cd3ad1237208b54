"""Arithmetic of a plan, from settings alone."""

import itertools

from headway.config import ModelConfig, PlannerConfig
from headway.planning.optimizers import make_optimizer
from headway.task import Task


def plan_flop(
    model: ModelConfig, planner: PlannerConfig, task: Task, evaluations: float | None = None
) -> float:
    """Floating-point operations of the matrix products of one environment's plan.

    The imagined rollouts are counted. Left out is what happens once per step, encoding the
    context, learning and choosing a head: less than a thousandth at the paper's sizes.

    Args:
        model: Settings of the networks.
        planner: Settings of the planner.
        task: The sizes of observations and actions.
        evaluations: Candidates that were scored; by default as many as the search may score.
    """
    if not model.learns:
        return 0.0
    # Averaged mean heads are folded into one; their variances are not.
    variances = model.num_heads if planner.head_selection == "average" else 1
    outputs = 1 + (0 if model.deterministic else variances)
    sizes = (task.feature_size + task.action_size, *model.hidden_sizes)
    recurrent = model.kind == "recurrent"  # four gates per unit
    products = sum(4 * (n + m) * m if recurrent else n * m for n, m in itertools.pairwise(sizes))
    per_step = 2.0 * (products + sizes[-1] * outputs * task.obs_size)
    if evaluations is None:
        evaluations = make_optimizer(planner).max_evaluations
    return evaluations * planner.num_particles * planner.horizon * per_step
