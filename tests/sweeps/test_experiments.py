"""The table of experiments and the jobs that they need."""

import json
from pathlib import Path

import fakes
import pytest

from headway.config import override
from headway.errors import ConfigError, RunError, UnknownNameError
from headway.sweeps.experiments import EXPERIMENTS, experiment, sweep_experiment
from headway.sweeps.jobs import Cell, Comparison, Job, fingerprint
from headway.training.methods import METHODS, PRESETS, make_config
from headway.training.train import train_run

ENVS = ("cartpole-swingup", "pendulum", "hopper", "slim-humanoid", "half-cheetah", "crippled-ant")


@pytest.mark.parametrize("name", EXPERIMENTS)
@pytest.mark.parametrize("preset", PRESETS)
def test_every_arm_is_another_run_in_every_environment(name, preset, tmp_path):
    comparison = Comparison(experiment(name), ENVS, (0, 1), preset, tmp_path)
    cells = comparison.cells
    assert len(cells) == 2 * len(ENVS) * len(comparison.experiment.arms)
    assert len(comparison.jobs) == len(cells)
    for cell, job in cells.items():
        assert (job.config.env, job.config.seed, job.config.preset) == (
            cell.env,
            cell.seed,
            preset,
        )


def arm_config(name, label):
    """What an arm runs on Pendulum."""
    comparison = Comparison(experiment(name), ("pendulum",), (0,), "quick", Path("nowhere"))
    return comparison.cells[Cell("pendulum", label, 0)].config


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
        found = Comparison(experiment(name), ("pendulum",), (3,), "quick", tmp_path)
        return found.cells[Cell("pendulum", label, 3)].path

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


def test_a_directory_stands_for_all_settings_but_the_seed(tmp_path):
    plain = make_config("pendulum", preset="quick")
    same = make_config("pendulum", preset="quick", seed=5, settings={"planner.horizon": 20})
    assert fingerprint(plain) == fingerprint(same)
    assert Job.of(plain, tmp_path).path.parent == Job.of(same, tmp_path).path.parent
    others = [
        {"planner.horizon": 21},
        {"model.hidden_sizes": [128, 128, 128]},
        {"sim_params": {"train": {"length": [0.5], "mass": [1.0]}, "unseen": {}}},
    ]
    names = {fingerprint(make_config("pendulum", preset="quick", settings=s)) for s in others}
    assert len({fingerprint(plain), *names}) == 4


def test_what_a_run_only_tolerates_does_not_separate_runs(tmp_path):
    plain = make_config("pendulum", method="random", preset="smoke")
    tolerant = {"evaluation.max_bad_episodes": 1, "collection.env_processes": True}
    job, same = Job.of(plain, tmp_path), Job.of(override(plain, tolerant), tmp_path)
    assert same.path == job.path
    train_run(job.config, job.path)
    assert same.finished


def test_settings_of_an_arm_win_over_those_of_the_comparison(tmp_path):
    chosen = {"model.num_heads": 4, "planner.horizon": 7}
    comparison = Comparison(experiment("fig14"), ("pendulum",), (0,), "smoke", tmp_path, chosen)
    configs = [job.config for job in comparison.jobs]
    assert [config.model.num_heads for config in configs] == [1, 2, 3, 5, 8]
    assert {config.planner.horizon for config in configs} == {7}


def test_jobs_of_the_first_seed_come_first(tmp_path):
    comparison = Comparison(experiment("fig13"), ("pendulum", "hopper"), (4, 2), "smoke", tmp_path)
    assert [job.config.seed for job in comparison.jobs] == [4, 4, 4, 4, 2, 2, 2, 2]


def test_another_run_in_the_directory_is_refused(tmp_path):
    job = fakes.tiny_job(tmp_path)
    fakes.write_run(fakes.tiny_job(tmp_path, **{"planner.horizon": 2}).config, job.path)
    with pytest.raises(RunError, match=r"other settings \(planner.horizon: 2 -> 3\)"):
        _ = job.finished
    fakes.write_run(job.config, tmp_path / "again")
    assert Job(job.config, tmp_path / "again").finished


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


def test_two_arms_with_the_same_settings_share_one_job(tmp_path):
    same = sweep_experiment("mine", ["tmcl"], {"fitting.weight_decay": [1, 1.0]})
    comparison = Comparison(same, ("pendulum",), (0,), "smoke", tmp_path)
    assert len(comparison.cells) == 2
    assert len(comparison.jobs) == 1


@pytest.mark.parametrize("name", ["fig13", "../up", "", "a b"])
def test_a_sweep_cannot_take_any_name(name):
    with pytest.raises(ConfigError, match="allowed: letters"):
        sweep_experiment(name, ["tmcl"], {})


def test_what_is_asked_twice_or_unknown_is_refused(tmp_path):
    with pytest.raises(ConfigError, match="each once"):
        sweep_experiment("mine", ["tmcl", "tmcl"], {})
    with pytest.raises(ConfigError, match="seeds is"):
        Comparison(experiment("fig13"), ("pendulum",), (1, 1), "smoke", tmp_path)
    with pytest.raises(ConfigError, match="envs is"):
        Comparison(experiment("fig13"), (), (1,), "smoke", tmp_path)
    twice = ("pendulum", "headway/Pendulum-v0")
    with pytest.raises(ConfigError, match="envs is"):
        Comparison(experiment("fig13"), twice, (1,), "smoke", tmp_path)
    with pytest.raises(UnknownNameError, match="Did you mean 'fig13'"):
        experiment("figg13")
    with pytest.raises(UnknownNameError, match="headway plot-dynamics"):
        experiment("fig8")


def test_references_are_arms():
    for found in EXPERIMENTS.values():
        assert found.reference_arm.label == (found.reference or found.arms[0].label)
        assert found.reference_arm in found.arms


def test_values_of_settings_are_plain():
    for found in EXPERIMENTS.values():
        for arm in found.arms:
            assert json.loads(json.dumps(dict(arm.settings))) == dict(arm.settings)
