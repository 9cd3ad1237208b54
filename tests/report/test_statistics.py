"""Against rliable's definitions, written out anew, and numbers that rliable 1.2.0 gave once."""

import itertools
import re

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy import stats

from headway.errors import ConfigError
from headway.report.statistics import (
    Improvement,
    caution,
    estimate,
    interquartile_mean,
    interval,
    mean,
    probability_of_improvement,
    standard_deviation,
    verdict,
)
from headway.training.references import normalised

# Five and four runs of four tasks, as rliable takes them: [run, task].
A = np.array(
    [
        [0.9, 0.645, 0.259, 0.366],
        [0.832, 0.451, 0.309, 0.701],
        [0.826, 0.507, 0.373, 0.554],
        [0.916, 0.46, 0.296, 0.604],
        [0.698, 0.531, 0.015, 0.307],
    ]
)
B = np.array(
    [
        [0.432, 0.553, -0.153, 0.366],
        [0.831, 0.563, -0.403, 0.392],
        [0.79, 0.623, -0.206, 0.404],
        [0.604, 0.438, 0.312, 0.338],
    ]
)
# What rliable's 20,000 (probability: 5,000) resamples gave; its draws are not ours.
RLIABLE_A = {"iqm": (0.5189, 0.4479, 0.5838), "mean": (0.5275, 0.47855, 0.57400125)}
RLIABLE_B = {"iqm": (0.43575, 0.40025, 0.481375), "mean": (None, 0.29375, 0.4481875)}
RLIABLE_IMPROVEMENT = 0.68125, 0.4875, 0.85

scores = st.lists(
    st.lists(st.floats(-5, 5).map(lambda x: round(x, 1)), min_size=1, max_size=7),
    min_size=1,
    max_size=4,
)


@pytest.mark.parametrize(("runs", "known"), [(A, RLIABLE_A), (B, RLIABLE_B)])
@pytest.mark.parametrize(("name", "statistic"), [("iqm", interquartile_mean), ("mean", mean)])
def test_numbers_of_rliable(runs, known, name, statistic):
    value, low, high = known[name]
    found = estimate(runs.T, statistic)
    if value is not None:
        assert found.value == pytest.approx(value, abs=1e-12)
    assert found.interval == pytest.approx((low, high), abs=0.006)
    assert found.num_runs == len(runs)


def test_probability_of_improvement_of_rliable():
    value, low, high = RLIABLE_IMPROVEMENT
    found = probability_of_improvement(A.T, B.T)
    assert found.value == pytest.approx(value, abs=1e-12)
    assert found.interval == pytest.approx((low, high), abs=0.015)
    other = probability_of_improvement(B.T, A.T)
    assert other.value == pytest.approx(1 - value, abs=1e-12)


@given(scores)
def test_interquartile_mean_leaves_out_a_quarter_at_either_end(tasks):
    everything = sorted(itertools.chain(*tasks))
    cut = len(everything) // 4
    kept = everything[cut : len(everything) - cut]
    assert float(interquartile_mean(tasks)) == pytest.approx(sum(kept) / len(kept), abs=1e-12)


@given(scores)
def test_mean_counts_every_task_once(tasks):
    of_tasks = [sum(task) / len(task) for task in tasks]
    assert float(mean(tasks)) == pytest.approx(sum(of_tasks) / len(of_tasks), abs=1e-12)


@given(scores, st.randoms())
def test_probability_of_improvement_counts_pairs(tasks, random):
    others = [
        [random.choice(task) + random.choice([-0.1, 0, 0.1]) for _ in "abc"] for task in tasks
    ]
    shares = [
        np.mean([(x > y) + 0.5 * (x == y) for x in first for y in second])
        for first, second in zip(tasks, others, strict=True)
    ]
    found = probability_of_improvement(tasks, others).value
    assert found == pytest.approx(np.mean(shares), abs=1e-12)
    statistic = [
        stats.mannwhitneyu(x, y).statistic / (len(x) * len(y))
        for x, y in zip(tasks, others, strict=True)
    ]
    assert found == pytest.approx(np.mean(statistic), abs=1e-12)


def test_standard_deviation_is_pooled_over_tasks():
    assert float(standard_deviation([[1.0, 2.0, 3.0]])) == pytest.approx(1.0)
    assert float(standard_deviation([[1.0, 3.0], [5.0, 5.0]])) == pytest.approx(1.0)
    assert standard_deviation([[1.0], [2.0]]) is None


def test_strata_are_resampled_among_themselves():
    # Tasks far apart, each without spread: no resample can mix them, so nothing varies.
    assert interval([[0.0] * 4, [100.0] * 4], mean) == (50.0, 50.0)
    low, high = interval([[0.0, 1.0, 2.0, 3.0]] * 2, mean)
    assert 0 < low < 1.5 < high < 3


def test_the_interval_of_a_mean_is_that_of_all_resamples():
    # With three runs all 27 resamples can be counted out.
    runs = np.array([1.0, 2.0, 6.0])
    means = sorted(np.mean(draw) for draw in itertools.product(runs, repeat=3))
    low, high = np.percentile(means, [10, 90])
    assert interval([runs], mean, confidence=0.8) == pytest.approx((low, high), abs=1e-9)


def test_an_interval_is_repeatable_and_narrows_with_confidence():
    assert interval(A.T) == interval(A.T)
    wide, narrow = interval(A.T, confidence=0.95), interval(A.T, confidence=0.5)
    assert wide[0] < narrow[0] < narrow[1] < wide[1]


@pytest.mark.parametrize("runs", [1, 2])
def test_nothing_is_claimed_from_fewer_than_three_seeds(runs):
    few = [[0.9 + i / 100 for i in range(runs)], [1.0, 1.1, 1.2, 1.3]]
    assert interval(few) is None
    many = [[0.1, 0.1, 0.1], [0.2, 0.2, 0.2]]
    found = probability_of_improvement(few, many)
    assert (found.value, found.interval, found.num_runs) == (1.0, None, runs)
    text = verdict("tmcl", "pets", found)
    assert f"{runs} seed" in text
    assert "too few to show that tmcl and pets differ (at least 3 of each are needed)" in text
    assert "tmcl is above pets in every pair of runs." in text


@pytest.mark.parametrize(
    ("improvement", "said"),
    [
        (Improvement(0.9, (0.7, 1.0), 5, 0.01, 0.008), "tmcl is better than pets (probability of"),
        (Improvement(0.1, (0.0, 0.4), 5, 0.01, 0.008), "pets is better than tmcl"),
        (Improvement(0.6, (0.5, 0.8), 5, 0.04, 0.008), "no difference between tmcl and pets is"),
        (Improvement(0.9, (0.7, 1.0), 5, 0.05, 0.008), "no difference between tmcl and pets is"),
    ],
)
def test_verdicts(improvement, said):
    text = verdict("tmcl", "pets", improvement)
    assert text.startswith(said)
    assert re.search(r"; p = 0.0[145]; 5 seeds\)", text)


def test_three_seeds_of_one_environment_show_no_difference():
    high, low = [[3.0, 4.0, 5.0]], [[0.0, 1.0, 2.0]]
    text = verdict("tmcl", "pets", probability_of_improvement(high, low))
    assert text == (
        "3 seeds: too few to show that tmcl and pets differ (the clearest result has p = 0.1);"
        " tmcl is above pets in every pair of runs."
    )
    text = verdict("pets", "tmcl", probability_of_improvement(low, high))
    assert text.endswith("; tmcl is above pets in every pair of runs.")
    text = verdict("a", "b", probability_of_improvement([[0.0, 1.0, 2.0]], [[-1.0, -1.0, 0.5]]))
    assert text.endswith("; a is above b in 89 % of the pairs of runs and groups.")
    # Groups of one environment are of the same models and add nothing; environments do.
    groups = probability_of_improvement(high * 2, low * 2, envs=["a", "a"])
    assert (groups.p_value, groups.lowest_p) == (0.1, 0.1)
    tasks = probability_of_improvement(high * 2, low * 2, envs=["a", "b"])
    assert (tasks.p_value, tasks.lowest_p) == (2 / 400, 2 / 400)
    assert verdict("tmcl", "pets", tasks).startswith("tmcl is better than pets")


def test_the_permutation_test_is_that_of_scipy():
    rng = np.random.default_rng(1)
    for sizes in ((5, 5), (4, 6), (9, 9)):
        x, y = (rng.normal([0.0, 5.0], size=(size, 2)) for size in sizes)
        x += 0.7

        def share(first, second, x=x, y=y):
            pooled = np.concatenate([x, y])
            first, second = pooled[first.astype(int)], pooled[second.astype(int)]
            return np.abs((first[:, None] > second[None]).mean() - 0.5)

        known = stats.permutation_test(
            (np.arange(sizes[0]), np.arange(sizes[0], sum(sizes))),
            share,
            alternative="greater",
            rng=np.random.default_rng(0),
            n_resamples=9999 if sum(sizes) <= 10 else 999,
        )
        found = probability_of_improvement(x.T, y.T, envs=["a", "a"])
        assert found.p_value == pytest.approx(known.pvalue, abs=1e-9 if sum(sizes) <= 10 else 0.05)


def test_seeds_are_drawn_whole_for_all_groups_of_an_environment():
    runs = np.array([0.0, 1.0, 2.0, 3.0])
    one = interval([runs], mean)
    assert interval([runs, runs], mean, envs=["a", "a"]) == one  # the same runs once more
    # What one group loses the other wins, run by run: their mean is the same in every draw.
    assert interval([runs, -runs], mean, envs=["a", "a"]) == (0, 0)
    low, high = interval([runs, -runs], mean, envs=["a", "b"])
    assert low < 0 < high
    one = probability_of_improvement([runs], [runs - 0.5])
    several = probability_of_improvement([runs] * 3, [runs - 0.5] * 3, envs="aaa")
    assert several.interval == one.interval
    with pytest.raises(ConfigError, match="4 and 3 runs"):
        interval([runs, runs[:3]], mean, envs=["a", "a"])


def test_few_seeds_ask_for_caution():
    assert "fewer than 10 seeds are too narrow" in caution(9)
    assert caution(10) == ""


def test_an_improvement_has_its_other_side():
    found = Improvement(0.75, (0.5, 1.0), 3, 0.2, 0.1)
    assert found.complement == Improvement(0.25, (0.0, 0.5), 3, 0.2, 0.1)
    assert Improvement(0.75, None, 2, 1, 1).complement == Improvement(0.25, None, 2, 1, 1)


def test_normalised():
    assert normalised(-1000.0, -1000.0, -200.0) == 0
    assert normalised(-200.0, -1000.0, -200.0) == 1
    assert normalised(-600.0, -1000.0, -200.0) == 0.5
    with pytest.raises(ConfigError, match="differ"):
        normalised(1.0, 5.0, 5.0)


@pytest.mark.parametrize("bad", [[], [[]], [[1.0], []]])
def test_scores_without_runs_are_refused(bad):
    with pytest.raises(ConfigError, match="one array per task"):
        interquartile_mean(bad)


def test_different_tasks_are_not_compared():
    with pytest.raises(ConfigError, match="2 and 1 tasks"):
        probability_of_improvement([[1.0], [2.0]], [[1.0]])
