"""The table of methods and presets, scores, and the rows of a run's tables."""

import dataclasses
import itertools

import pytest

from headway.config import CEMConfig, Config, override
from headway.errors import ConfigError
from headway.planning.rollouts import plan_flop
from headway.task import env_names, env_spec
from headway.training.evaluate import group_episodes
from headway.training.methods import METHODS, PRESETS, config_to_evaluate, make_config
from headway.training.references import score
from headway.training.run import format_sim_params, parse_sim_params


@pytest.mark.parametrize("method", METHODS)
def test_every_combination_is_a_valid_configuration(method):
    for env, preset in itertools.product(env_names(), PRESETS):
        config = make_config(env, method=method, preset=preset)
        assert (config.env, config.method, config.preset) == (env, method, preset)


def test_paper_preset_is_the_defaults_its_own_search_and_the_environments_epochs():
    own_search = {"planner.optimizer.narrow_at_bounds": True}
    assert make_config("half-cheetah") == override(Config("half-cheetah"), own_search)
    assert make_config("pendulum").fitting.epochs == 5


@pytest.mark.parametrize("method", ["tmcl", "pets"])
@pytest.mark.parametrize("env", ["hopper", "pendulum"])
def test_fast_preset_plans_with_a_hundredth_of_the_papers_arithmetic_and_changes_nothing_else(
    method, env
):
    paper, fast = (make_config(env, method=method, preset=name) for name in ("paper", "fast"))
    task = env_spec(env).make_task()
    candidates = ((paper, 5 * 200.0), (fast, 100 + 80 + 64 + 3 * 3 + 1.0))  # and kept, and the mean
    costs = [plan_flop(config.model, config.planner, task, n) for config, n in candidates]
    assert 100 * costs[1] <= costs[0]
    assert dataclasses.replace(fast, preset="paper", planner=paper.planner) == paper


def test_sizes_are_the_papers_at_its_scale_and_smaller_in_smaller_presets():
    for method, paper, quick in (("grbal", (512,) * 3, (128,) * 3), ("rebal", (256,), (128,))):
        for preset, sizes in (("paper", paper), ("quick", quick)):
            config = make_config("pendulum", method=method, preset=preset)
            assert config.model.hidden_sizes == sizes


def test_released_code_preset_flips_the_choices_that_differ():
    config = make_config("hopper", preset="released-code")
    fitting, planner = config.fitting, config.planner
    assert (fitting.bootstrap, fitting.drop_first_anchor) == (True, True)
    assert not fitting.context_weight_decay
    assert (planner.selection_error, planner.reward) == ("sampled", "released")
    assert planner.selection_skips_newest
    assert planner.optimizer == CEMConfig(narrow_at_bounds=True)
    assert config.env_options == {"observe_average_velocity": False}


def test_method_wins_over_preset_and_user_over_both():
    for settings, particles in (
        ({}, 1),
        ({"planner.num_particles": 4, "planner.particle_noise": "independent"}, 4),
    ):
        config = make_config("pendulum", method="vanilla", preset="quick", settings=settings)
        assert config.planner.num_particles == particles


def test_a_test_may_change_only_settings_that_training_did_not_fix():
    config = make_config("pendulum", method="mcl")
    changed = config_to_evaluate(config, {"planner.optimizer.name": "icem", "evaluation.every": 2})
    assert (changed.planner.optimizer.name, changed.evaluation.every) == ("icem", 2)
    for name, sections in (
        ("model.num_heads", ("planner", "evaluation")),
        ("evaluation.every", ("planner",)),
    ):
        with pytest.raises(ConfigError, match=f"{name} cannot change here, allowed: settings of"):
            config_to_evaluate(config, {name: 1}, sections)


@pytest.mark.parametrize(
    ("option", "says"),
    [
        ({"terminate_off_trak": True}, "Did you mean 'terminate_off_track'"),
        ({"terminate_off_track": "yes"}, "allowed: True or False"),
        ({"terminate_off_track": {1}}, "JSON"),
        ({"terminate_off_track": [float("nan")]}, "allowed: a finite number"),
    ],
)
def test_environment_options_that_do_not_exist_or_fit_are_refused(option, says):
    with pytest.raises(ConfigError, match=says) as caught:
        make_config("cartpole-swingup", settings={"env_options": option})
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("env", env_names())
def test_test_episodes_are_fixed_distinct_and_spread_evenly(env):
    sets = env_spec(env).sim_params
    groups = {group: group_episodes(sets, group, 10, 10_000) for group in sets.group_names}
    seeds = [episode.seed for episodes in groups.values() for episode in episodes]
    assert len(set(seeds)) == len(seeds)
    for group, episodes in groups.items():
        counts = [sum(e.sim_params == p for e in episodes) for p in sets.group(group)]
        assert max(counts) - min(counts) <= 1
    assert groups == {group: group_episodes(sets, group, 10, 10_000) for group in sets.group_names}


def test_score_is_zero_for_random_and_one_for_the_ceiling():
    assert score("pendulum", {"length": 0.5, "mass": 1.0}, -1501, 200) == 0
    assert score("pendulum", {"length": 0.5, "mass": 1.0}, -126, 200) == 1
    assert score("pendulum", {"length": 0.6, "mass": 1.0}, -126, 200) is None
    assert score("pendulum", {"length": 0.5, "mass": 2.0}, -126, 200) is None
    assert score("pendulum", {"length": 0.5, "mass": 1.0}, -126, 100) is None
    assert score("pendulum", {"gain": 1.0}, -131, 200) == 1  # the rest as in the unchanged one
    assert score("pendulum", {"length": 0.5, "mass": 1.0, "gain": -1.0}, -126, 200) is None
    assert score("hopper", {"mass_scale": 1.0}, 10, 500) is None


def test_sim_params_survive_their_cell():
    sim_params = {"mass_scale": 0.375, "damping_scale": 1.0}
    assert format_sim_params(sim_params) == "damping_scale=1 mass_scale=0.375"
    odd = ("mass [kg]", "a=b", 'say "x"=2', '"', "\\", "", "µ\n=1 b")
    sim_params |= dict.fromkeys(odd, -1e-9)
    assert parse_sim_params(format_sim_params(sim_params)) == sim_params
    for wrong in ("length", "length=", "=1", "length=x", "length=1=2", 'a "b=1', "[kg] mass=1"):
        with pytest.raises(ValueError, match=r"form|float"):
            parse_sim_params(wrong)
