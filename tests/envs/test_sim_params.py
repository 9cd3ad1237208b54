import dataclasses
import json

import jax.numpy as jnp
import numpy as np
import pandas as pd
import pytest

from headway.errors import ConfigError, UnknownNameError
from headway.sim_params import SimParamSets, Uniform

SETS = SimParamSets(
    {"mass": (1.0, 2.0), "length": (0.5, 3.0)},
    {"low": {"mass": (0.1, 0.2), "length": (0.5,)}},
)


def test_groups_are_all_combinations_and_samples_uniform():
    assert SETS.group_names == ("train", "low")
    assert SETS.group("low") == [{"mass": 0.1, "length": 0.5}, {"mass": 0.2, "length": 0.5}]
    with pytest.raises(UnknownNameError, match="Did you mean 'low'"):
        SETS.group("lov")
    rng = np.random.default_rng(0)
    draws = [SETS.sample(rng) for _ in range(2000)]
    for physics in SETS.group("train"):
        assert 0.2 < draws.count(physics) / 2000 < 0.3
    assert SimParamSets.from_dict(json.loads(json.dumps(dataclasses.asdict(SETS)))) == SETS


def test_values_may_be_lists_and_numpys_arrays_and_numbers():
    train = {"mass": [np.float32(1), 2], "length": np.linspace(0.5, 3.0, 2)}
    sets = SimParamSets(train, {"low": {"mass": [0.1, 0.2], "length": (np.float64(0.5),)}})
    assert sets == SETS
    assert {type(value) for group in sets.group("train") for value in group.values()} == {float}
    for leg in (range(3), jnp.arange(3), pd.Series([0, 1, 2])):
        assert SimParamSets({"leg": leg}).train == {"leg": (0.0, 1.0, 2.0)}


def test_ranges_are_drawn_from_evenly_and_tested_evenly():
    given = {"mass": Uniform(np.float32(0.5), 2), "leg": (0, 1)}
    sets = SimParamSets(given, {"low": {"mass": {"low": 0, "high": 0.5}, "leg": [2]}})
    rng = np.random.default_rng(0)
    draws = np.sort([sets.sample(rng)["mass"] for _ in range(2000)])
    np.testing.assert_allclose(draws, np.linspace(0.5, 2, 2000), atol=0.05)
    spread = sets.spread("train", 6)
    assert sorted(one["mass"] for one in spread) == pytest.approx(np.linspace(0.5, 2, 6))
    assert [one["leg"] for one in spread].count(1.0) == 3
    assert sets.spread("low", 1) == [{"mass": 0.25, "leg": 2.0}]
    assert len(sets.group("train")) == 10
    assert sets.nearest({"mass": 0.6, "leg": 1.0}) == {"mass": 0.5, "leg": 1.0}
    assert SimParamSets.from_dict(json.loads(json.dumps(dataclasses.asdict(sets)))) == sets


@pytest.mark.parametrize(
    "values",
    [
        {},
        {"train": {}},
        {"train": {"mass": []}},
        {"train": {"mass": 1.0}},
        {"train": {"mass": [float("nan")]}},
        {"train": {"mass": ["1"]}},
        {"train": {"mass": [True]}},
        {"train": {0: [1.0]}},
        {"train": {"mass": np.ones((2, 2))}},
        {"train": {"mass": range(0)}},
        {"train": {"mass": {"low": 1.0}}},
        {"train": {"mass": {"low": 2.0, "high": 1.0}}},
        {"train": {"mass": {"low": 2.0, "high": float("inf")}}},
        {"train": {"mass": [1.0]}, "unsen": {}},
        {"train": {"mass": [1.0]}, "unseen": [1]},
        {"train": {"mass": [1.0]}, "unseen": {"train": {"mass": [1.0]}}},
        {"train": {"mass": [1.0]}, "unseen": {"low": {"mas": [1.0]}}},
        {"train": {"mass": [1.0], "l": [1.0]}, "unseen": {"low": {"mass": [1.0]}}},
        None,
    ],
)
def test_bad_sets_are_refused_in_one_line(values):
    with pytest.raises(ConfigError) as caught:
        SimParamSets.from_dict(values)
    assert "\n" not in str(caught.value)


def test_a_part_of_a_grid_has_every_value_equally_often():
    values = (0.5, 0.75, 1.0, 1.25, 1.5)
    sets = SimParamSets({"mass": values, "damping": values, "gravity": (1.0,)})
    found = sets.spread("train", 10)
    for name in ("mass", "damping"):
        assert [sum(physics[name] == value for physics in found) for value in values] == [2] * 5
    assert len({tuple(physics.items()) for physics in found}) >= 8  # no diagonal
    assert found == sets.spread("train", 10)
    assert sets.spread("train", 30) == [*sets.group("train"), *sets.group("train")[:5]]
