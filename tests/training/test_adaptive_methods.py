"""GrBAL and ReBAL through the whole loop: every environment, resuming, testing again."""

import numpy as np
import pytest

import headway
from headway.errors import ConfigError
from headway.training import train
from headway.training.methods import make_config

TINY = {"collection.episode_length": 30, "fitting.epochs": 2}
SPREAD = [
    ("grbal", "pendulum"),
    ("grbal", "hopper"),
    ("grbal", "slim-humanoid"),
    ("rebal", "cartpole-swingup"),
    ("rebal", "half-cheetah"),
    ("rebal", "crippled-ant"),
]


@pytest.mark.parametrize(("method", "env"), SPREAD)
def test_smoke_run(method, env, tmp_path):
    run = headway.train(env, method=method, preset="smoke", run_dir=tmp_path, settings=TINY)
    assert [m["iteration"] for m in run.metrics] == [0, 1]
    assert np.isfinite([m["fitting"]["loss"] for m in run.metrics]).all()
    errors = train.RunDir(tmp_path).prediction_errors()
    assert {row["step"] for row in errors} == {1, 2, 3, 4}
    assert all(0 < row["error"] < np.inf for row in errors)
    controller = headway.load(tmp_path)
    controller.act(np.zeros(controller.agent.task.obs_size))
    assert controller.heads is None


def test_sizes_are_the_papers_at_its_scale_and_smaller_in_smaller_presets():
    sizes = {
        (method, preset): make_config("pendulum", method=method, preset=preset).model.hidden_sizes
        for method in ("grbal", "rebal")
        for preset in ("paper", "quick")
    }
    assert sizes == {
        ("grbal", "paper"): (512, 512, 512),
        ("grbal", "quick"): (128, 128, 128),
        ("rebal", "paper"): (256,),
        ("rebal", "quick"): (128,),
    }


def test_settings_that_a_kind_of_model_has_not_are_refused():
    with pytest.raises(ConfigError, match=r"num_heads is a setting of .* multi-headed only"):
        make_config("pendulum", method="rebal", settings={"model.num_heads": 3})
    with pytest.raises(ConfigError, match=r"kind is 'recurent'\. Did you mean 'recurrent'"):
        make_config("pendulum", settings={"model.kind": "recurent"})
