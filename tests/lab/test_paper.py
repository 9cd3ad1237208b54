"""The table of experiments and the jobs that they need."""

import operator

import fakes
import pytest

from headway.errors import ConfigError, UnknownNameError
from headway.lab.paper import EXPERIMENTS, Arm, experiment, sweep_experiment
from headway.training.methods import METHODS, PRESETS


@pytest.mark.parametrize("name", EXPERIMENTS)
@pytest.mark.parametrize("preset", PRESETS)
def test_every_arm_is_another_run_in_every_environment(name, preset, tmp_path):
    comparison = fakes.comparison(tmp_path, name, ("pendulum", "hopper"), (1,), preset)
    cells = comparison.cells
    assert len(comparison.jobs) == len(cells) == 2 * len(comparison.experiment.arms)
    asked = comparison.experiment
    assert (asked.reference or asked.arms[0].label) in [arm.label for arm in asked.arms]
    for (env, _, seed), job in cells.items():
        assert (job.config.env, job.config.seed, job.config.preset) == (env, seed, preset)


@pytest.mark.parametrize(
    ("name", "setting", "values"),
    [
        ("fig10", "method", ["pets", "mh-pets"]),
        ("fig11", "planner.head_selection", ["adaptive", "average"]),
        ("fig12", "model.context_size", [10, 0]),
        ("fig12", "model.backward_net", [True, False]),
        ("fig13", "fitting.oracle", ["transition", "trajectory"]),
        ("fig14", "model.num_heads", [1, 2, 3, 5, 8]),
        ("fig15", "fitting.oracle", ["transition", *4 * ["trajectory"]]),
        ("fig15", "fitting.segment_length", [10, 5, 10, 20, 50]),
        ("fig16", "planner.selection_length", [1, 5, 10, 20, 50]),
        ("comparison", "method", list(METHODS)),
    ],
)
def test_arms_are_what_the_supplement_compares(name, setting, values, tmp_path):
    jobs = fakes.comparison(tmp_path, name, preset="quick").cells.values()
    assert [operator.attrgetter(setting)(job.config) for job in jobs] == values


def test_figures_share_the_runs_that_they_have_in_common(tmp_path):
    def path(name, label):
        return fakes.comparison(tmp_path, name).cells["pendulum", label, 0].path

    shared = {
        path("fig11", "adaptive"),
        path("fig12", "with context"),
        path("fig13", "tmcl"),
        path("fig14", "H = 3"),
        path("fig15", "M = 10"),
        path("fig16", "N = 10"),
        path("comparison", "tmcl"),
    }
    assert len(shared) == 1
    assert path("fig13", "mcl") == path("fig15", "M = 1")
    assert path("fig13", "mcl") not in shared


def test_a_sweep_has_an_arm_per_method_and_combination():
    grid = {"planner.horizon": [5, 10], "fitting.epochs": [1]}
    arms = sweep_experiment("mine", ["tmcl", "pets"], grid).arms
    chosen = {"planner.horizon": 10, "fitting.epochs": 1}
    assert len(arms) == 4
    assert arms[3] == Arm("pets, planner.horizon 10, fitting.epochs 1", "pets", chosen)


def test_returns_while_learning_are_of_methods_that_learn():
    arms = {arm.label for arm in EXPERIMENTS["fig9"].arms}
    assert {*METHODS} - arms == {"random", "true-dynamics"}


def test_what_is_unknown_or_asked_twice_is_refused():
    for name in ("fig13", "../up", "", "a b"):
        with pytest.raises(ConfigError, match="allowed: letters"):
            sweep_experiment(name, ["tmcl"], {})
    with pytest.raises(ConfigError, match="each once"):
        sweep_experiment("mine", ["tmcl", "tmcl"], {})
    with pytest.raises(UnknownNameError, match="Did you mean 'fig13'"):
        experiment("figg13")
    with pytest.raises(UnknownNameError, match="headway plot-dynamics"):
        experiment("fig8")
