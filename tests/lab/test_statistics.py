"""Statistics over seeds against values worked out by hand."""

import numpy as np
import pandas as pd
import pytest

from headway.lab import statistics as stats
from headway.lab.statistics import Estimate, mean


def column(*values):
    return np.array(values, float)[:, None]


def test_the_interquartile_mean_drops_a_quarter_at_either_end():
    assert stats.interquartile_mean([column(0, 1, 2, 3, 4, 5, 6, 100)]) == 3.5
    assert stats.interquartile_mean([column(0, 3, 6)]) == 3.0  # too few to leave any out
    both = [np.array([[0.0, 10.0], [2.0, 14.0]]), column(4, 6)]  # two tasks and one
    assert stats.interquartile_mean(both) == (2 + 4 + 6 + 10) / 4
    assert mean(both) == (1 + 12 + 5) / 3


def test_intervals_come_from_three_seeds_on():
    assert stats.estimate([column(1, 2)]).interval is None
    assert stats.estimate([column(1, 2, 3), column(1, 2)]).interval is None
    low, high = stats.estimate([column(1, 2, 3)]).interval
    assert 1 <= low < 2 < high <= 3
    assert stats.estimate([column(5, 5, 5)]).interval == (5.0, 5.0)


def test_intervals_cover_the_truth_about_as_often_as_they_say():
    rng = np.random.default_rng(1)
    inside = 0
    for _ in range(60):
        low, high = stats.estimate([rng.normal(0, 1, (20, 1))], mean).interval
        inside += low <= 0 <= high
    assert 48 <= inside <= 60


def test_groups_of_an_environment_are_drawn_together():
    runs = np.arange(6.0)[:, None]
    alone = stats.estimate([runs, -runs], mean).interval
    together = stats.estimate([np.hstack([runs, -runs])], mean).interval
    assert together == (0.0, 0.0)
    assert alone[0] < 0 < alone[1]


def test_probability_of_improvement_is_the_share_of_won_pairs():
    found = stats.improvement([column(1, 2, 3)], [column(2, 3, 4)])
    assert found.value == pytest.approx((0.5 + 1 + 0.5) / 9)
    assert found.lowest_p == pytest.approx(2 / 20)
    apart = stats.improvement([column(*range(10, 16))], [column(*range(6))])
    assert apart.value == 1
    assert apart.interval == (1.0, 1.0)
    assert apart.p_value == pytest.approx(2 / 924, abs=2e-3)


@pytest.mark.parametrize(
    ("found", "says"),
    [
        (Estimate(1.0, None, 2), "2 seeds: too few to show that A and B differ (at least 3 of each"
         " are needed); A is above B in every pair of runs."),
        (Estimate(0.0, (0.0, 0.0), 3, 0.1, 0.1), "3 seeds: too few to show that A and B differ (the"
         " clearest result has p = 0.1); B is above A in every pair of runs."),
        (Estimate(0.9, (0.7, 1.0), 5, 0.01, 0.008), "A is better than B (probability of improvement"
         " 0.90, 0.70 to 1.00; p = 0.01; 5 seeds)."),
        (Estimate(0.1, (0.0, 0.3), 5, 0.01, 0.008), "B is better than A"),
        (Estimate(0.6, (0.4, 0.8), 5, 0.4, 0.008), "no difference between A and B is shown"),
        (Estimate(0.9, (0.7, 1.0), 5, 0.06, 0.008), "no difference between A and B is shown"),
    ],
)  # fmt: skip
def test_claims_are_no_stronger_than_the_numbers(found, says):
    assert stats.verdict("A", "B", found).startswith(says)


def test_few_seeds_are_warned_of():
    assert "fewer than 10 seeds" in stats.caution(9)
    assert stats.caution(10) == ""


def parts(values, protocol="p", **columns):
    lines = [
        {"env": "e", "label": label, "run": f"{label}{i}", "group": "low", "sim_params": "x=1",
         "protocol": protocol, "value": value, **columns}
        for label, numbers in values.items()
        for i, value in enumerate(numbers)
    ]  # fmt: skip
    return pd.DataFrame(lines)


def test_only_what_was_tested_alike_is_compared():
    both = parts({"A": (1, 2, 3), "B": (0, 0, 0)})
    assert stats.compare(both, "A", "B", "value").value == 1
    longer = parts({"B": (9, 9, 9)}, protocol="longer")
    assert stats.compare(pd.concat([both[both.label == "A"], longer]), "A", "B", "value") is None
    # A group that one of the runs lacks does not count.
    high = parts({"A": (0, 0, 0), "B": (5, 5)}, group="high")
    assert stats.compare(pd.concat([both, high]), "A", "B", "value").value == 1
