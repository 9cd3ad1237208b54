"""How the finished runs of an arm did in their last tests, group by group."""

import numpy as np

from headway.report.comparison.runs import Found
from headway.report.tables import Facts, by_group
from headway.training.run import RunDir


def last_tests(found: Found, env: str, arm: str) -> list[list[Facts]]:
    """Return and score of each group after the last iteration (`tables.by_group`), by run."""
    runs = []
    for cell, job in found.cells.items():
        if (cell.env, cell.arm) == (env, arm) and cell not in found.missing:
            last = job.num_iterations - 1
            rows = [row for row in RunDir(job.path).evaluation() if row.iteration == last]
            runs.append(by_group(rows, job.config))
    return runs


def unseen_scores(tests: list[list[Facts]]) -> list[float]:
    """Mean score of the unseen groups of each run that has one on all of them."""
    scores = [[one["score"] for one in run if one["group"] != "train"] for run in tests]
    return [float(np.mean(of_run)) for of_run in scores if of_run and None not in of_run]
