"""Settings: written and read back unchanged, replaced by name, refused in one teaching line."""

import dataclasses
import json

import pytest

from headway.config import (
    CollectionConfig,
    Config,
    EvaluationConfig,
    FittingConfig,
    ModelConfig,
    PlannerConfig,
)
from headway.errors import ConfigError
from headway.experiment.methods import config_to_evaluate, make_config
from headway.settings import (
    TOLERANCE,
    differences,
    from_dict,
    override,
    setting_names,
    to_dict,
    tolerating_as,
)
from headway.sim_params import SimParamSets

SETS = SimParamSets({"length": (0.5, 1.0)}, {"long": {"length": (1.5, 2.0)}})


def changed():
    """A configuration whose every kind of field differs from its default."""
    return Config(
        env="pendulum",
        method="pets",
        seed=7,
        env_options={"inertia": True},
        sim_params=SETS,
        model=ModelConfig(hidden_sizes=(16, 8), num_members=2, deterministic=True),
        fitting=FittingConfig(oracle="independent", learning_rate=3e-4),
        planner=PlannerConfig(num_particles=4, head_selection="random"),
        collection=CollectionConfig(episode_length=20),
        evaluation=EvaluationConfig(training_group="always"),
    )


@pytest.mark.parametrize("config", [Config(env="hopper"), changed()], ids=["default", "changed"])
def test_a_configuration_survives_json_unchanged(config):
    text = json.dumps(to_dict(config))
    assert from_dict(json.loads(text)) == config
    assert json.loads(json.dumps(to_dict(from_dict(json.loads(text))))) == json.loads(text)


def test_settings_may_be_left_out_and_take_their_defaults():
    assert from_dict({"env": "hopper"}) == Config(env="hopper")
    assert from_dict({"env": "hopper", "planner": {"horizon": 3}}).planner.horizon == 3
    with pytest.raises(ConfigError, match=r"^the settings lack env\.$"):
        from_dict({})


NEW_PLANNER_SETTINGS = (
    "noise_beta", "population_decay", "kept_elite_fraction", "temperature",
)  # fmt: skip


def test_a_run_of_before_the_newest_settings_takes_their_defaults():
    old = to_dict(changed())
    for name in NEW_PLANNER_SETTINGS:
        del old["planner"][name]
    assert from_dict(json.loads(json.dumps(old))) == changed()


def test_defaults_are_the_papers():
    config = Config(env="hopper")
    model, fitting, planner = config.model, config.fitting, config.planner
    assert (model.num_members, model.num_heads, model.hidden_sizes) == (5, 3, (200,) * 4)
    assert (model.context_hidden_sizes, model.context_size, model.history_length) == (
        (256, 128, 64),
        10,
        10,
    )
    assert (fitting.oracle, fitting.segment_length, fitting.warmup_iterations) == (
        "trajectory",
        10,
        3,
    )
    assert (fitting.epochs, fitting.batch_size, fitting.learning_rate) == (50, 256, 1e-3)
    assert (fitting.future_length, fitting.bootstrap) == (5, False)
    assert (planner.horizon, planner.num_candidates, planner.num_elites) == (30, 200, 50)
    assert (planner.num_iterations, planner.num_particles, planner.selection_length) == (5, 20, 10)
    assert (config.collection.num_iterations, config.collection.num_episodes) == (10, 10)


def test_every_leaf_has_a_dotted_name():
    names = setting_names(Config(env="hopper"))
    assert {"env", "sim_params", "planner.horizon", "model.hidden_sizes"} <= set(names)
    assert len(names) == len(set(names))
    assert not {"model", "fitting", "planner", "collection", "evaluation"} & set(names)


def test_override_replaces_the_named_settings_only():
    base = changed()
    got = override(
        base,
        {"planner.horizon": 3, "seed": 1, "model.hidden_sizes": [4], "fitting.learning_rate": 1},
    )
    assert got.planner == dataclasses.replace(base.planner, horizon=3)
    assert got.model == dataclasses.replace(base.model, hidden_sizes=(4,))
    assert got.seed == 1
    assert got.fitting.learning_rate == 1.0
    assert type(got.fitting.learning_rate) is float
    assert (got.collection, got.sim_params) == (base.collection, SETS)
    assert override(base, {}) == base


def test_override_takes_simulator_parameters_and_none():
    plain = Config(env="pendulum")
    assert override(plain, {"sim_params": SETS}).sim_params == SETS
    assert override(plain, {"sim_params": SETS.to_dict()}).sim_params == SETS
    assert override(changed(), {"sim_params": None}).sim_params is None


@pytest.mark.parametrize(
    ("wrong", "meant"),
    [
        ("planner.horizn", "planner.horizon"),
        ("horizon", "planner.horizon"),
        ("num_head", "model.num_heads"),
        ("fiting.epochs", "fitting.epochs"),
        ("sed", "seed"),
    ],
)
def test_an_unknown_setting_suggests_the_closest(wrong, meant):
    with pytest.raises(ConfigError) as caught:
        override(Config(env="hopper"), {wrong: 3})
    text = str(caught.value)
    assert f"unknown setting {wrong!r}" in text
    assert f"Did you mean {meant!r}?" in text
    assert "\n" not in text


def test_an_unknown_setting_in_a_file_suggests_the_closest():
    with pytest.raises(ConfigError, match=r"'planner\.horizn'.*Did you mean 'planner\.horizon'"):
        from_dict({"env": "hopper", "planner": {"horizn": 3}})


@pytest.mark.parametrize(
    ("name", "value", "allowed"),
    [
        ("planner.horizon", "many", "int"),
        ("planner.horizon", 3.0, "int"),
        ("planner.horizon", True, "int"),
        ("planner.horizon", None, "int"),
        ("fitting.learning_rate", "fast", "float"),
        ("fitting.learning_rate", True, "float"),
        ("fitting.bootstrap", 1, "bool"),
        ("model.hidden_sizes", 200, "tuple"),
        ("model.hidden_sizes", [200, "wide"], "int"),
        ("env_options", {"inertia": 1}, "Mapping"),
        ("fitting.oracle", 3, "Literal"),
        ("env", 3, "str"),
    ],
)
def test_a_value_of_the_wrong_type_is_refused_by_name(name, value, allowed):
    with pytest.raises(ConfigError) as caught:
        override(Config(env="hopper"), {name: value})
    text = str(caught.value)
    assert text.startswith(f"{name} is ")
    assert "allowed: " in text
    assert allowed in text
    assert "\n" not in text


@pytest.mark.parametrize("value", [3, None, ["horizon"]])
def test_a_section_that_is_no_table_is_refused(value):
    with pytest.raises(ConfigError, match=r"^planner is .*allowed: a table of settings"):
        from_dict({"env": "hopper", "planner": value})


@pytest.mark.parametrize(
    ("section", "settings"),
    [
        (ModelConfig, {"num_members": 0, "num_heads": -1, "context_size": -1, "hidden_sizes": ()}),
        (ModelConfig, {"history_length": 0, "context_hidden_sizes": (3, 0)}),
        (FittingConfig, {"epochs": 0, "batch_size": 0, "learning_rate": 0.0, "oracle": "tmcl"}),
        (FittingConfig, {"backward_weight": -0.1, "weight_decay": float("nan"), "reduction": "x"}),
        (FittingConfig, {"learning_rate": float("nan"), "logvar_bound_weight": float("inf")}),
        (PlannerConfig, {"horizon": 0, "num_elites": 300, "smoothing": 1.5, "optimizer": "sem"}),
        (PlannerConfig, {"reward": "paper", "selection_error": "raw", "initial_std": 0.0}),
        (PlannerConfig, {"temperature": 0.0}),
        (PlannerConfig, {"noise_beta": -1.0, "population_decay": 0.9, "kept_elite_fraction": 1.1}),
        (CollectionConfig, {"num_iterations": 0, "num_episodes": 0, "episode_length": -1}),
        (CollectionConfig, {"max_bad_episodes": -1, "step_timeout_s": 0.0}),
        (EvaluationConfig, {"max_bad_episodes": -1}),
        (EvaluationConfig, {"every": 0, "num_episodes": 0, "seed": -1, "training_group": "no"}),
    ],
)
def test_all_values_out_of_range_are_reported_at_once_in_one_line(section, settings):
    with pytest.raises(ConfigError) as caught:
        section(**settings)
    text = str(caught.value)
    for name, value in settings.items():
        assert f"{name} is {value!r}" in text
    assert text.count("allowed: ") == len(settings)
    assert "\n" not in text


def test_problems_of_several_sections_and_kinds_are_reported_at_once_in_one_line():
    wrong = {
        "seed": "x",
        "model.num_heads": 0,
        "planner.horizon": 1.5,
        "planner.optimizer": 3,
        "fitting.epochs": 0,
    }
    with pytest.raises(ConfigError) as caught:
        override(Config(env="hopper"), wrong)
    text = str(caught.value)
    for name, value in wrong.items():
        assert f"{name.removeprefix('model.').removeprefix('fitting.')} is {value!r}" in text
    assert "\n" not in text


def test_a_misspelt_choice_is_suggested():
    with pytest.raises(ConfigError, match=r"did you mean 'trajectory'\?\), allowed: independent, "):
        FittingConfig(oracle="trajectry")


def test_settings_that_contradict_each_other_are_refused():
    with pytest.raises(ConfigError, match=r"num_elites is 50, allowed: at most half of .*\(80\)"):
        PlannerConfig(optimizer="icem", num_candidates=80)
    assert PlannerConfig(optimizer="icem", num_candidates=100).num_elites == 50
    assert PlannerConfig(optimizer="mppi", num_candidates=20).num_elites == 50
    with pytest.raises(ConfigError, match="nothing of a selection_length of 1"):
        PlannerConfig(selection_skips_newest=True, selection_length=1)
    with pytest.raises(ConfigError, match=r"num_particles is 7, allowed: a multiple of.*\(5\)"):
        Config(env="hopper", planner=PlannerConfig(num_particles=7))


def test_what_a_model_has_no_use_for_is_refused():
    with pytest.raises(ConfigError, match="'context': 'sim-params'"):
        make_config("pendulum", method="rebal", settings={"model.context": "sim-params"})


@pytest.mark.parametrize(
    ("method", "settings", "refused"),
    [
        ("grbal", {"planner.adaptation": "last-layer"}, "planner.adaptation"),
        ("tmcl", {"planner.change_threshold": 0.1}, "planner.change_threshold"),
        ("tmcl", {"planner.temperature": 0.7}, "planner.temperature"),
        ("tmcl", {"planner.temperature": 0.7, "planner.optimizer": "mppi"}, None),
        ("tmcl", {"planner.change_threshold": 0.0, "planner.horizon": 3}, None),
    ],
)
def test_a_test_with_settings_that_change_nothing_is_refused(method, settings, refused):
    config = make_config("pendulum", method=method)
    if refused is None:
        assert config_to_evaluate(config, settings) == override(config, settings)
    else:
        with pytest.raises(ConfigError, match=f"{refused} would change nothing for {method}"):
            config_to_evaluate(config, settings)


def test_what_concerns_the_whole_is_named_without_a_section():
    with pytest.raises(ConfigError, match=r"^bad settings: seed is -1, allowed: 0 to 2147483647"):
        Config(env="hopper", seed=-1)


def test_differences_name_each_changed_setting_with_both_values():
    old = Config(env="hopper")
    new = override(
        old, {"planner.horizon": 3, "model.hidden_sizes": (4,), "env_options": {"inertia": True}}
    )
    lines = differences(old, new)
    assert "planner.horizon: 30 -> 3" in lines
    assert "model.hidden_sizes: [200, 200, 200, 200] -> [4]" in lines
    assert any(line.startswith("env_options") for line in lines)
    assert all("hopper" not in line for line in lines)
    assert differences(old, from_dict(json.loads(json.dumps(to_dict(old))))) == []


def test_plans_on_the_simulator_need_it_in_their_own_process():
    plain = {"num_members": 1, "num_heads": 1, "context_size": 0, "backward_net": False}
    model = ModelConfig(kind="simulator", deterministic=True, **plain)
    planner = PlannerConfig(num_particles=1)
    Config(env="pendulum", model=model, planner=planner)
    with pytest.raises(ConfigError, match=r"collection\.env_processes is True, allowed: False"):
        Config(
            "pendulum",
            model=model,
            planner=planner,
            collection=CollectionConfig(env_processes=True),
        )


def test_what_is_tolerated_of_environments_is_taken_over_and_nothing_else():
    other = override(changed(), {name: 9 for name in TOLERANCE if "max" in name})
    other = override(other, {"collection.env_processes": True, "planner.horizon": 3})
    found = tolerating_as(changed(), other)
    assert len(differences(changed(), found)) == 3
    assert differences(found, other) == ["planner.horizon: 30 -> 3"]
