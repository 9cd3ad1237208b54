"""Settings: written and read back unchanged, replaced by name, refused in one teaching line."""

import dataclasses
import json

import numpy as np
import pytest

from headway.config import (
    TOLERANCE,
    CEMConfig,
    CollectionConfig,
    Config,
    EvaluationConfig,
    FittingConfig,
    GradientAdaptedConfig,
    ICEMConfig,
    MultiHeadedConfig,
    PlannerConfig,
    RandomShootingConfig,
    RecurrentConfig,
    SimulatorConfig,
    differences,
    from_dict,
    override,
    to_dict,
    tolerating_as,
)
from headway.errors import ConfigError
from headway.sim_params import SimParamSets

SETS = SimParamSets({"length": (0.5, 1.0)}, {"long": {"length": (1.5, 2.0)}})
DEFAULT = Config(env="hopper")
CHANGED = Config(
    env="pendulum",
    method="pets",
    seed=7,
    env_options={"inertia": True},
    sim_params=SETS,
    model=MultiHeadedConfig(hidden_sizes=(16, 8), num_members=2, deterministic=True),
    fitting=FittingConfig(oracle="independent", learning_rate=3e-4),
    planner=PlannerConfig(num_particles=4, optimizer=ICEMConfig(noise_beta=0.5)),
    collection=CollectionConfig(episode_length=20),
    evaluation=EvaluationConfig(training_group="always"),
)
ADAPTED = dataclasses.replace(CHANGED, model=GradientAdaptedConfig(adaptation_rate=0.5))


@pytest.mark.parametrize("config", [DEFAULT, CHANGED, ADAPTED], ids=["default", "other", "grbal"])
def test_a_configuration_survives_json_unchanged(config):
    text = json.dumps(to_dict(config))
    assert from_dict(json.loads(text)) == config
    assert json.dumps(to_dict(from_dict(json.loads(text)))) == text


def test_settings_may_be_left_out_and_take_their_defaults():
    assert from_dict({"env": "hopper"}) == DEFAULT
    assert from_dict({"env": "hopper", "planner": {"horizon": 3}}).planner.horizon == 3
    with pytest.raises(ConfigError, match=r"^the settings lack env\.$"):
        from_dict({})


def test_defaults_are_the_papers():
    model, fitting, planner = DEFAULT.model, DEFAULT.fitting, DEFAULT.planner
    assert (model.num_members, model.num_heads, model.hidden_sizes) == (5, 3, (200,) * 4)
    context = (model.context_hidden_sizes, model.context_size, model.history_length)
    assert context == ((256, 128, 64), 10, 10)
    assignment = (fitting.oracle, fitting.segment_length, fitting.warmup_iterations)
    assert assignment == ("trajectory", 10, 3)
    assert (fitting.epochs, fitting.batch_size, fitting.learning_rate) == (50, 256, 1e-3)
    assert (fitting.future_length, fitting.bootstrap) == (5, False)
    assert planner.optimizer == CEMConfig(num_elites=50)
    assert (planner.horizon, planner.num_candidates, planner.num_iterations) == (30, 200, 5)
    assert (planner.num_particles, planner.selection_length) == (20, 10)
    assert (DEFAULT.collection.num_iterations, DEFAULT.collection.num_episodes) == (10, 10)


def test_override_replaces_the_named_settings_only():
    asked = {"planner.horizon": np.int64(3), "seed": 1, "model.hidden_sizes": np.array([4])}
    got = override(CHANGED, {**asked, "fitting.learning_rate": 1})
    assert got.planner == dataclasses.replace(CHANGED.planner, horizon=3)
    assert got.model == dataclasses.replace(CHANGED.model, hidden_sizes=(4,))
    assert (got.seed, repr(got.fitting.learning_rate)) == (1, "1.0")
    assert (got.collection, got.sim_params) == (CHANGED.collection, SETS)
    assert override(CHANGED, {}) == CHANGED


def test_override_takes_simulator_parameters_and_none():
    for asked in (SETS, dataclasses.asdict(SETS)):
        assert override(DEFAULT, {"sim_params": asked}).sim_params == SETS
    assert override(CHANGED, {"sim_params": None}).sim_params is None


def test_another_optimizer_keeps_the_settings_that_both_have():
    few = override(DEFAULT, {"planner.optimizer.num_elites": 7, "planner.optimizer.smoothing": 0.3})
    icem = override(few, {"planner.optimizer.name": "icem", "planner.optimizer.noise_beta": 1})
    assert icem.planner.optimizer == ICEMConfig(num_elites=7, smoothing=0.3, noise_beta=1.0)
    shooting = override(icem, {"planner.optimizer.name": "random-shooting"})
    assert shooting.planner.optimizer == RandomShootingConfig()
    again = override(shooting, {"planner.optimizer.name": "cem"})
    assert again.planner.optimizer == CEMConfig()


def test_another_kind_of_model_keeps_the_settings_that_both_have():
    asked = {"model.kind": "recurrent", "planner.num_particles": 1}
    assert override(CHANGED, asked).model == RecurrentConfig(hidden_sizes=(16, 8))


@pytest.mark.parametrize(
    ("wrong", "said"),
    [
        ("planner.horizn", "Did you mean 'planner.horizon'?"),
        ("horizon", "Did you mean 'planner.horizon'?"),
        ("num_head", "Did you mean 'model.num_heads'?"),
        ("fiting.epochs", "Did you mean 'fitting.epochs'?"),
        ("sed", "Did you mean 'seed'?"),
        ("planner.num_elites", "Did you mean 'planner.optimizer.num_elites'?"),
        ("planner.optimizer", "Did you mean 'planner.optimizer.name'?"),
        ("planner.optimizer.action_cost", "a setting of planner.optimizer.name ilqr only"),
        ("model.adaptation_rate", "a setting of model.kind gradient-adapted only"),
    ],
)
def test_a_setting_that_does_not_exist_is_refused_with_the_closest(wrong, said):
    with pytest.raises(ConfigError) as caught:
        override(DEFAULT, {wrong: 3})
    text = str(caught.value)
    assert wrong in text
    assert said in text
    assert "\n" not in text


@pytest.mark.parametrize(
    ("name", "value", "allowed"),
    [
        ("planner.horizon", "many", "a valid integer"),
        ("planner.horizon", 3.0, "a valid integer"),
        ("planner.horizon", True, "a valid integer"),
        ("planner.horizon", 0, "greater than or equal to 1"),
        ("planner.horizon", 10**30, "less than or equal to"),
        ("planner.optimizer.smoothing", 1.5, "less than or equal to 1"),
        (
            "planner.optimizer.name",
            "icm",
            "Did you mean 'icem'? Allowed: cem, icem, random-shooting, ilqr",
        ),
        ("planner.num_particles", 7, "a multiple of model.num_members (5), or 1 without"),
        ("model.num_heads", -1, "greater than or equal to 1"),
        ("model.kind", "unheard", "Allowed: multi-headed, gradient-adapted, recurrent, "),
        ("model.hidden_sizes", 200, "a valid tuple"),
        ("model.hidden_sizes", [], "at least 1 item"),
        ("fitting.learning_rate", float("nan"), "a finite number"),
        ("fitting.bootstrap", 1, "a valid boolean"),
        ("fitting.oracle", "trajectry", "'trajectory'. Did you mean 'trajectory'?"),
        ("evaluation.num_episodes", 1001, "less than or equal to 1000"),
        ("seed", -1, "greater than or equal to 0"),
    ],
)
def test_a_bad_value_is_refused_by_name_in_one_line(name, value, allowed):
    with pytest.raises(ConfigError) as caught:
        override(DEFAULT, {name: value})
    text = str(caught.value)
    assert text.startswith(f"{name} is ")
    assert allowed in text
    assert "\n" not in text


@pytest.mark.parametrize("value", [3, None, ["horizon"]])
@pytest.mark.parametrize("section", ["planner", "model"])
def test_a_section_that_is_no_table_is_refused(section, value):
    with pytest.raises(ConfigError, match=rf"^{section} is .*allowed: "):
        from_dict({"env": "hopper", section: value})


def test_all_that_is_wrong_is_told_at_once():
    wrong = {"seed": "x", "model.num_heads": 0, "planner.horizon": 1.5, "fitting.epochs": 0}
    with pytest.raises(ConfigError) as caught:
        override(DEFAULT, wrong)
    assert all(f"{name} is {value!r}" in str(caught.value) for name, value in wrong.items())
    assert "\n" not in str(caught.value)


def test_settings_that_contradict_each_other_are_refused():
    with pytest.raises(ConfigError, match=r"num_elites is 50, allowed: at most half of .*\(80\)"):
        PlannerConfig(optimizer=ICEMConfig(num_elites=50), num_candidates=80)
    with pytest.raises(ConfigError, match="nothing of a selection_length of 1"):
        PlannerConfig(selection_skips_newest=True, selection_length=1)
    with pytest.raises(ConfigError, match="allowed: one head and a learned context"):
        MultiHeadedConfig(relation_head=True)
    related = MultiHeadedConfig(relation_head=True, num_heads=1)
    with pytest.raises(ConfigError, match=r"fitting\.precision is 'bfloat16', allowed: float32"):
        Config("hopper", model=related, fitting=FittingConfig(precision="bfloat16"))
    with pytest.raises(ConfigError, match=r"num_particles is 10, allowed: 1 or model.num_memb"):
        Config("hopper", planner=PlannerConfig(num_particles=10, particle_noise="none"))


@pytest.mark.parametrize(
    ("model", "settings", "refused"),
    [
        (SimulatorConfig(), {"planner.num_particles": 2}, "num_particles is 2, allowed: 1"),
        (SimulatorConfig(), {"planner.reward": "released"}, "planner.reward is 'released'"),
        (SimulatorConfig(), {"collection.env_processes": True}, "env_processes is True, allowed"),
        (RecurrentConfig(), {"planner.adaptation": "last-layer"}, "planner.adaptation is "),
    ],
)
def test_settings_that_a_model_has_no_use_for_are_refused(model, settings, refused):
    config = Config("pendulum", model=model, planner=PlannerConfig(num_particles=1))
    with pytest.raises(ConfigError, match=refused):
        override(config, settings)


def test_differences_name_each_changed_setting_with_both_values():
    changes = {"planner.horizon": 3, "model.hidden_sizes": (4,), "env_options": {"inertia": True}}
    lines = differences(DEFAULT, override(DEFAULT, changes))
    assert "planner.horizon: 30 -> 3" in lines
    assert "model.hidden_sizes: [200, 200, 200, 200] -> [4]" in lines
    assert any(line.startswith("env_options") for line in lines)
    assert differences(DEFAULT, from_dict(json.loads(json.dumps(to_dict(DEFAULT))))) == []


def test_tolerance_of_broken_episodes_is_taken_over_and_nothing_else():
    other = override(CHANGED, {name: 9 for name in TOLERANCE if "max" in name})
    other = override(other, {"planner.horizon": 3})
    assert differences(tolerating_as(CHANGED, other), other) == ["planner.horizon: 30 -> 3"]
