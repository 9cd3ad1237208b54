"""Settings that a run cannot use: they change nothing of it, and tell it apart from no other."""

import dataclasses
import typing

import pytest

import runs
from headway.config.unused import OPTIMIZER_SETTINGS, unused_settings
from headway.errors import RunError
from headway.experiment.methods import METHODS, make_config
from headway.planning.optimizers import make_optimizer
from headway.settings import differences, flatten, override, to_dict
from headway.sweeps.jobs import Job, fingerprint
from headway.training import train

ONE_ITERATION = {
    "collection.num_iterations": 1,
    "collection.episode_length": 8,
    "fitting.epochs": 1,
    "fitting.warmup_iterations": 0,
    "planner.horizon": 3,
}
SHARED_BY_OPTIMIZERS = {"num_candidates", "num_iterations"}

NAMES = {  # directories that hold results must be found again
    "tmcl": "13042c68de",
    "tmcl-bayes": "1b70078ff7",
    "mcl": "90e22fa1f3",
    "pets": "a928ac7801",
    "pets-bayes": "a546389e68",
    "mh-pets": "4101495b58",
    "vanilla": "9cec50d054",
    "stacked": "62d52411d8",
    "cadm": "aea84d06c7",
    "pets-cadm": "3fb965948a",
    "oracle-params": "d622870d5d",
    "ria": "0a12a47247",
    "grbal": "8cb2585637",
    "rebal": "534e074606",
    "random": "448d0e3aea",
    "true-dynamics": "9bd86ea8cf",
}


def another(config, name):
    """A valid value of a setting that is not the one it has."""
    section, _, field = name.partition(".")
    part = getattr(config, section)
    value, hint = getattr(part, field), typing.get_type_hints(type(part))[field]
    if typing.get_origin(hint) is typing.Literal:
        return next(choice for choice in typing.get_args(hint) if choice != value)
    if isinstance(value, bool):
        return not value
    if isinstance(value, tuple):
        return [*value, 7]
    return value + 1 if isinstance(value, int) else 1.1 * value + 0.01


def with_others_unused(config):
    """The same run, asked for with other values of everything that it cannot use."""
    values = {name: another(config, name) for name in unused_settings(config)}
    changed = override(config, values)
    before, after = flatten(to_dict(config)), flatten(to_dict(changed))
    assert {name for name in before if before[name] != after[name]} == set(values)
    return changed


# A preset that sets what some methods cannot use renames their runs: see `Preset`.
@pytest.mark.parametrize("method", METHODS)
def test_runs_are_found_under_the_names_that_they_have(method):
    config = make_config("pendulum", method=method, preset="quick")
    assert fingerprint(config) == NAMES[method]


@pytest.mark.parametrize(
    ("selection", "name"), [("adaptive", "2633089082"), ("average", "172e1b266d")]
)
def test_so_are_runs_with_settings_of_their_own(selection, name):
    asked = {"collection.episode_length": 500, "planner.head_selection": selection}
    assert fingerprint(make_config("cartpole-swingup", preset="quick", settings=asked)) == name


@pytest.mark.parametrize("method", METHODS)
def test_what_a_method_cannot_use_does_not_separate_runs(method, tmp_path):
    config = make_config("pendulum", method=method, preset="quick")
    changed = with_others_unused(config)
    assert differences(config, changed) == differences(changed, config) == []
    assert Job.of(config, tmp_path).path == Job.of(changed, tmp_path).path


def test_what_a_method_can_use_separates_runs():
    def separates(method, name, **settings):
        config = make_config("pendulum", method=method, preset="quick", settings=settings)
        changed = override(config, {name: another(config, name)})
        apart = fingerprint(config) != fingerprint(changed)
        assert apart == bool(differences(config, changed))
        return apart

    mppi = {"planner.optimizer": "mppi"}
    assert separates("ria", "fitting.relation_transitions")
    assert not separates("tmcl", "fitting.relation_transitions")
    assert separates("tmcl", "planner.temperature", **mppi)
    assert not separates("tmcl", "planner.temperature")
    assert separates("tmcl", "planner.num_elites")
    assert not separates("tmcl", "planner.num_elites", **mppi)
    assert separates("tmcl", "fitting.segment_length")
    assert not separates("mcl", "fitting.segment_length")
    assert separates("mcl", "fitting.warmup_iterations")
    assert not separates("mh-pets", "fitting.warmup_iterations")
    assert separates("tmcl-bayes", "planner.change_threshold")
    assert not separates("tmcl", "planner.change_threshold")
    assert separates("rebal", "fitting.backprop_steps")
    assert not separates("grbal", "fitting.backprop_steps")
    assert separates("pets", "fitting.precision")
    assert not separates("grbal", "fitting.precision")
    assert separates("true-dynamics", "planner.num_candidates")
    assert not separates("random", "planner.num_candidates")


def test_switches_of_methods_always_count():
    for method in METHODS:
        idle = unused_settings(make_config("pendulum", method=method))
        assert "model.kind" not in idle
        assert not {"env", "method", "preset", "seed", "sim_params"} & idle
        assert not any(name.startswith("evaluation.") for name in idle)
        assert (len(idle) > 40) == (method == "random")


@pytest.mark.parametrize("name", OPTIMIZER_SETTINGS)
def test_the_settings_of_an_optimizer_are_all_that_it_takes(name):
    planner = make_config("pendulum", settings={"planner.optimizer": name}).planner
    fields = {field.name for field in dataclasses.fields(make_optimizer(planner))}
    assert fields == {*OPTIMIZER_SETTINGS[name], *SHARED_BY_OPTIMIZERS}


SLOW = [
    "tmcl",
    "mcl",
    "mh-pets",
    "pets",
    "stacked",
    "vanilla",
    "ria",
    "grbal",
    "rebal",
    "true-dynamics",
]


@pytest.mark.parametrize(
    "method", ["random", *(pytest.param(method, marks=pytest.mark.slow) for method in SLOW)]
)
def test_what_a_run_cannot_use_changes_nothing_of_it(method, tmp_path):
    config = make_config("pendulum", method=method, preset="smoke", settings=ONE_ITERATION)
    for name, asked in {"plain": config, "other": with_others_unused(config)}.items():
        train.train_run(asked, tmp_path / name)
    assert runs.result(tmp_path / "plain") == runs.result(tmp_path / "other")


def test_a_run_goes_on_whatever_is_asked_of_what_it_cannot_use(tmp_path):
    config = make_config("pendulum", method="random", preset="smoke", settings=ONE_ITERATION)
    written = train.train_run(config, tmp_path / "run").metrics()
    assert train.train_run(with_others_unused(config), tmp_path / "run").metrics() == written
    used = override(config, {"evaluation.num_episodes": 3})
    with pytest.raises(RunError, match=r"other settings \(evaluation.num_episodes: 2"):
        train.train_run(used, tmp_path / "run")
