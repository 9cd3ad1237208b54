"""What planning costs in arithmetic, from settings alone."""

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
    if evaluations is None:
        evaluations = make_optimizer(planner).max_evaluations
    return evaluations * planner.num_particles * planner.horizon * step_flop(model, planner, task)


def step_flop(model: ModelConfig, planner: PlannerConfig, task: Task) -> float:
    """Operations of one particle's step, which depend on the kind of model.

    Multi-headed: the backbone, one mean head, the variance heads. The mean heads of an average
    are folded into one; their variances are not. Recurrent: four gates per unit. Where nothing
    is learned there are no networks.
    """
    if not model.learns:
        return 0.0
    heads_of_variance = model.num_heads if planner.head_selection == "average" else 1
    outputs = 1 + (0 if model.deterministic else heads_of_variance)
    sizes = (task.feature_size + task.action_size, *model.hidden_sizes)
    products = [n * m for n, m in itertools.pairwise(sizes)]
    if model.kind == "recurrent":
        products = [4 * (n + m) * m for n, m in itertools.pairwise(sizes)]
    total = sum(products) + sizes[-1] * outputs * task.obs_size
    return float(2 * total)
