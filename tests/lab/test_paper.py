"""The table of experiments and the jobs that they need."""

import json
from pathlib import Path

import fakes
import pytest

from headway.errors import ConfigError, UnknownNameError
from headway.lab.paper import EXPERIMENTS, experiment, sweep_experiment
from headway.training.methods import METHODS, PRESETS


@pytest.mark.parametrize("name", EXPERIMENTS)
@pytest.mark.parametrize("preset", PRESETS)
def test_every_arm_is_another_run_in_every_environment(name, preset, tmp_path):
    comparison = fakes.comparison(tmp_path, name, ("pendulum", "hopper"), (1,), preset)
    cells = comparison.cells
    assert len(comparison.jobs) == len(cells) == 2 * len(comparison.experiment.arms)
    for (env, _, seed), job in cells.items():
        assert (job.config.env, job.config.seed, job.config.preset) == (env, seed, preset)


def arm_config(name, label):
    """What an arm runs on Pendulum."""
    found = fakes.comparison(Path("nowhere"), name, preset="quick")
    return found.cells["pendulum", label, 0].config


def test_arms_are_what_the_supplement_compares():
    assert [arm.method for arm in experiment("fig10").arms] == ["pets", "mh-pets"]
    heads = [arm_config("fig11", arm.label).planner for arm in experiment("fig11").arms]
    assert [planner.head_selection for planner in heads] == ["adaptive", "average"]
    without = arm_config("fig12", "without context").model
    assert (without.context_size, without.backward_net) == (0, False)
    oracles = [arm_config("fig13", arm.label).fitting for arm in experiment("fig13").arms]
    assert [fitting.oracle for fitting in oracles] == ["transition", "trajectory"]
    heads = [arm_config("fig14", arm.label).model.num_heads for arm in experiment("fig14").arms]
    assert heads == [1, 2, 3, 5, 8]
    lengths = [
        1 if fitting.oracle == "transition" else fitting.segment_length
        for fitting in (arm_config("fig15", arm.label).fitting for arm in experiment("fig15").arms)
    ]
    assert lengths == [1, 5, 10, 20, 50]
    planners = [arm_config("fig16", arm.label).planner for arm in experiment("fig16").arms]
    assert [planner.selection_length for planner in planners] == [1, 5, 10, 20, 50]
    assert [arm.method for arm in experiment("comparison").arms] == list(METHODS)


def test_figures_share_the_runs_that_they_have_in_common(tmp_path):
    def path(name, label):
        return fakes.comparison(tmp_path, name).cells["pendulum", label, 0].path

    shared = {
        path("fig11", "adaptive"),
        path("fig12", "with context"),
        path("fig13", "T-MCL"),
        path("fig14", "H = 3"),
        path("fig15", "M = 10"),
        path("fig16", "N = 10"),
        path("comparison", "T-MCL"),
    }
    assert len(shared) == 1
    assert path("fig13", "MCL") == path("fig15", "M = 1") == path("oracle", "transition-wise")
    assert path("fig13", "MCL") not in shared


def test_a_sweep_has_an_arm_per_method_and_combination():
    grid = {"planner.horizon": [5, 10], "fitting.epochs": [1]}
    arms = sweep_experiment("mine", ["tmcl", "pets"], grid).arms
    assert [arm.label for arm in arms] == [
        "T-MCL, planner.horizon 5, fitting.epochs 1",
        "T-MCL, planner.horizon 10, fitting.epochs 1",
        "PETS, planner.horizon 5, fitting.epochs 1",
        "PETS, planner.horizon 10, fitting.epochs 1",
    ]
    assert arms[3].settings == {"planner.horizon": 10, "fitting.epochs": 1}


@pytest.mark.parametrize("name", ["fig13", "../up", "", "a b"])
def test_a_sweep_cannot_take_any_name(name):
    with pytest.raises(ConfigError, match="allowed: letters"):
        sweep_experiment(name, ["tmcl"], {})


def test_what_is_unknown_or_asked_twice_is_refused():
    with pytest.raises(ConfigError, match="each once"):
        sweep_experiment("mine", ["tmcl", "tmcl"], {})
    with pytest.raises(UnknownNameError, match="Did you mean 'fig13'"):
        experiment("figg13")
    with pytest.raises(UnknownNameError, match="headway plot-dynamics"):
        experiment("fig8")


@pytest.mark.parametrize("found", EXPERIMENTS.values(), ids=EXPERIMENTS)
def test_arms_are_plain_and_the_reference_is_one_of_them(found):
    assert found.reference_arm.label == (found.reference or found.arms[0].label)
    for arm in found.arms:
        assert json.loads(json.dumps(dict(arm.settings))) == dict(arm.settings)
