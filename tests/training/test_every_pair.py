"""Methods in environments, at smoke size: from training to an agent that is loaded.

By default a few; all pairs are `make test-slow`.
"""

import math

import numpy as np
import pandas as pd
import pytest

import headway
from headway.task import env_names
from headway.training.methods import METHODS

TINY = {
    "collection.num_episodes": 1,  # one plan serves the run and the controller
    "collection.episode_length": 16,
    "fitting.epochs": 1,
    "evaluation.num_episodes": 1,
}
DEFAULT = {
    ("tmcl-bayes", "half-cheetah"),
    ("stacked", "pendulum"),
    ("grbal", "hopper"),
    ("rebal", "cartpole-swingup"),
    ("true-dynamics", "crippled-ant"),
    *(("random", env) for env in env_names()),
}
PAIRS = [
    pytest.param(method, env, marks=() if (method, env) in DEFAULT else pytest.mark.slow)
    for method in METHODS
    for env in env_names()
]


@pytest.mark.parametrize(("method", "env"), PAIRS)
def test_smoke_run(method, env, tmp_path):
    run = headway.train(env, method=method, preset="smoke", run_dir=tmp_path, settings=TINY)
    learns, sets = run.config.model.learns, headway.env_spec(env).sim_params
    assert [m["iteration"] for m in run.metrics] == ([0, 1] if learns else [0])
    fits = [m["fitting"] for m in run.metrics if learns]
    assert all(math.isfinite(fit["loss"]) and fit["skipped_updates"] == 0 for fit in fits)
    assert {row.group for row in run.evaluation} == set(sets.group_names)
    assert all(dict(row.sim_params) in sets.group(row.group) for row in run.evaluation)
    assert np.isfinite([row.episode_return for row in run.evaluation]).all()
    errors = pd.read_csv(tmp_path / "prediction_error.csv")
    assert {*errors.step} == ({1, 2, 3, 4} if learns else set())
    assert ((errors.error > 0) & (errors.error < np.inf)).all()
    if method == "true-dynamics":
        return
    controller = headway.load(tmp_path)
    controller.reset(sim_params=dict(run.evaluation[0].sim_params))  # oracle-params wants it told
    action = controller.act(np.zeros(controller.agent.task.obs_size))
    assert action.shape == (controller.agent.task.action_size,)
    assert np.isfinite(action).all()
    assert (controller.heads is None) == (run.config.model.kind != "multi-headed")
