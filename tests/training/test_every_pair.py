"""Every method on every environment, at smoke size: from training to an agent that is loaded."""

import math

import numpy as np
import pytest

import headway
from headway.errors import ConfigError
from headway.task import env_names
from headway.training.methods import METHODS

TINY = {
    "collection.episode_length": 12,
    "fitting.epochs": 1,
    "evaluation.every": 1,
    "evaluation.num_episodes": 1,
}
ENVS = tuple(env_names())
PAIRS = [(method, env) for method in METHODS for env in ENVS]
TRAINED_ELSEWHERE = {"tmcl", "grbal", "rebal", "true-dynamics"}  # by default too


def is_quick(method: str, env: str) -> bool:
    """One environment for each method, in turn, and all of them for what compiles nothing."""
    turn = list(METHODS).index(method) % len(ENVS)
    return method == "random" or (ENVS[turn] == env and method not in TRAINED_ELSEWHERE)


def marked(method: str, env: str):
    """The rest takes minutes: `make test-slow`."""
    return pytest.param(method, env, marks=() if is_quick(method, env) else pytest.mark.slow)


@pytest.mark.parametrize(("method", "env"), [marked(*pair) for pair in PAIRS])
def test_smoke_run(method, env, tmp_path):
    run = headway.train(env, method=method, preset="smoke", run_dir=tmp_path, settings=TINY)
    learns = run.config.model.learns
    assert [m["iteration"] for m in run.metrics] == ([0, 1] if learns else [0])
    fits = [m["fitting"] for m in run.metrics if learns]
    assert all(math.isfinite(fit["loss"]) and fit["skipped_updates"] == 0 for fit in fits)
    assert {row.group for row in run.evaluation} >= set(headway.env_spec(env).sim_params.unseen)
    assert np.isfinite([row.episode_return for row in run.evaluation]).all()
    if method == "true-dynamics":
        with pytest.raises(ConfigError, match="on the true dynamics has no controller"):
            headway.load(tmp_path)
        return
    controller = headway.load(tmp_path)
    controller.reset(sim_params=dict(run.evaluation[0].sim_params))  # oracle-params wants it told
    action = controller.act(np.zeros(controller.agent.task.obs_size))
    assert action.shape == (controller.agent.task.action_size,)
    assert np.isfinite(action).all()


def test_every_method_and_every_environment_is_quick_somewhere():
    quick = [pair for pair in PAIRS if is_quick(*pair)]
    assert {method for method, _ in quick} == {*METHODS} - TRAINED_ELSEWHERE
    assert {env for _, env in quick} == set(ENVS)
