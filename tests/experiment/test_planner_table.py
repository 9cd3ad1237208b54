"""The scripts that compare planners: their settings are valid, their Pareto line is one."""

import dataclasses
from pathlib import Path

import pytest

from headway.experiment.methods import config_to_evaluate, make_config

SCRIPTS = Path(__file__).parents[2] / "results" / "planners"


@pytest.fixture
def scripts(monkeypatch):
    monkeypatch.syspath_prepend(str(SCRIPTS))
    import measure
    import plot

    return measure, plot


@pytest.mark.parametrize("method", ["tmcl", "vanilla"])
@pytest.mark.parametrize("preset", ["paper", "quick", "smoke"])
def test_every_planner_of_the_comparison_is_another_valid_one(scripts, method, preset):
    measure, _ = scripts
    config = make_config("pendulum", method=method, preset=preset)
    table = measure.distinct(config)
    found = [config_to_evaluate(config, settings).planner for settings in table.values()]
    assert len(found) >= 12
    assert len({str(dataclasses.asdict(planner)) for planner in found}) == len(found)
    assert {planner.optimizer for planner in found} == {"cem", "icem", "mppi", "random-shooting"}


@pytest.mark.parametrize(
    ("env", "name"), [("hopper", "fast"), ("pendulum", "fast, icem, beta 0.25")]
)
def test_the_preset_fast_is_among_the_planners_compared(scripts, env, name):
    measure, _ = scripts
    paper, fast = (make_config(env, preset=preset) for preset in ("paper", "fast"))
    settings = measure.distinct(paper)[name]
    assert config_to_evaluate(paper, settings).planner == fast.planner


def test_a_measured_planner_is_skipped_and_a_changed_one_refused(scripts):
    measure, _ = scripts
    row = {"run": "a", "planner": "cem", "physics": "training", "settings": "{}"}
    assert measure.already_there([row], row)
    assert not measure.already_there([row], row | {"physics": "unseen"})
    with pytest.raises(SystemExit, match="write to another table"):
        measure.already_there([row | {"settings": "[]"}], row)


def test_the_pareto_line_leaves_out_what_a_cheaper_planner_equals(scripts):
    _, plot = scripts
    costs = {
        "a": (1, 0.2),
        "b": (2, 0.5),
        "c": (3, 0.5),
        "d": (4, 0.4),
        "e": (5, 0.9),
        "f": (1, 0.1),
    }
    points = [plot.Point(name, "cem", flop, 0.0, (value,)) for name, (flop, value) in costs.items()]
    assert [point.planner for point in plot.pareto(points)] == ["a", "b", "e"]
