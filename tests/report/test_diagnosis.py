import json
import shutil
from pathlib import Path

import numpy as np
import pytest

import headway
from headway.cli import main
from headway.errors import ConfigError
from headway.report import diagnosis

SAMPLE = Path(__file__).parent.parent / "data" / "run-schema-2"  # two of three iterations


@pytest.fixture
def run_dir(tmp_path):
    return Path(shutil.copytree(SAMPLE, tmp_path / "run"))


def files(path):
    return {file: file.read_bytes() for file in path.rglob("*") if file.is_file()}


def test_diagnose_runs_the_tests_of_a_run(run_dir, capsys):
    before = files(run_dir)
    assert main(["diagnose", str(run_dir), "--json", "--quiet"]) == 0
    said = json.loads(capsys.readouterr().out)
    assert [group["group"] for group in said["groups"]] == ["train", "low", "high"]
    assert said["settled_after"] == 10
    for group in said["groups"]:
        assert group["episodes"] == 2
        assert np.shape(group["head_errors"]) == (2, 3)
        assert group["regret"] == pytest.approx(group["chosen_error"] - group["best_error"])
        assert group["average_error"] == pytest.approx(np.mean(group["head_errors"]))
        assert 0 <= group["wrong_selections"] <= 1
        inside = list(group["calibration"]["inside"].values())
        assert inside == sorted(inside)
        assert sum(physics["episodes"] for physics in group["physics"]) == 2
    assert files(run_dir) == before
    assert diagnosis.facts(headway.diagnose(run_dir))["groups"] == said["groups"]


def test_diagnose_collected_episodes(run_dir, capsys):
    assert main(["diagnose", str(run_dir), "--collected"]) == 0
    out = capsys.readouterr().out
    for title in ("Head selection", "Error of each head", "Calibration of the predicted variance"):
        assert title in out
    assert "training, collected" in out
    found = headway.diagnose(run_dir, collected=True)
    assert [len(e.errors) for e in found.episodes["collected"]] == [11, 11]
    with pytest.raises(ConfigError, match="collected"):
        headway.diagnose(run_dir, collected=True, groups=["low"])


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["--group", "lo"], "unknown group 'lo'. Did you mean 'low'?"),
        (["--episodes", "0"], "num_episodes is 0"),
    ],
)
def test_what_diagnose_refuses(run_dir, words, said, capsys):
    assert main(["diagnose", str(run_dir), *words, "--quiet"]) == 1
    assert said in capsys.readouterr().err


def test_only_models_with_heads_are_diagnosed(tmp_path):
    run = headway.train("pendulum", method="random", preset="smoke", run_dir=tmp_path / "run")
    with pytest.raises(ConfigError, match="a run of random, which has no prediction heads"):
        headway.diagnose(run.path)


def test_only_runs_are_diagnosed(tmp_path, capsys):
    assert main(["diagnose", str(tmp_path)]) == 1
    assert "config.json is missing" in capsys.readouterr().err
