import json
import shutil
from pathlib import Path

import numpy as np
import pytest

import headway
from headway.cli import main
from headway.errors import ConfigError, RunError, UnknownNameError
from headway.lab import diagnose as lab
from headway.training.methods import make_config
from headway.training.run import RunDir


@pytest.fixture
def run_dir(two_iterations, tmp_path):
    return Path(shutil.copytree(two_iterations, tmp_path / "run"))


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
    assert lab.facts(headway.diagnose(run_dir))["groups"] == said["groups"]


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


@pytest.mark.parametrize("words", [[], ["--collected"]])
def test_only_trained_runs_are_diagnosed(tmp_path, words, capsys):
    RunDir(tmp_path / "run").begin(make_config("pendulum", preset="smoke"))
    assert main(["diagnose", str(tmp_path / "run"), "--quiet", *words]) == 1
    assert "has no finished iteration yet" in capsys.readouterr().err


def test_only_runs_are_diagnosed(tmp_path, capsys):
    assert main(["diagnose", str(tmp_path)]) == 1
    assert "config.json is missing" in capsys.readouterr().err


@pytest.fixture(scope="module")
def tested(tmp_path_factory):
    path = tmp_path_factory.mktemp("tested") / "run"
    settings = {"evaluation.num_episodes": 3, "collection.num_iterations": 2}
    headway.train("pendulum", preset="smoke", run_dir=path, settings=settings)
    return path


def test_the_tests_of_a_run_are_not_run_again(tested, monkeypatch):
    run = RunDir(tested)
    kept = run.tests()
    assert [t.returns for found in kept.values() for t in found] == [
        row.episode_return for row in run.evaluation() if row.iteration == 1
    ]

    def never(*args, **kwargs):
        raise AssertionError("tests were run")

    with monkeypatch.context() as patched:
        patched.setattr(lab, "evaluate", never)
        found = headway.diagnose(tested)
        assert {group: len(episodes) for group, episodes in found.episodes.items()} == {
            "train": 3,
            "low": 3,
            "high": 3,
        }
        assert list(headway.diagnose(tested, groups=["high"]).episodes) == ["high"]
        with pytest.raises(UnknownNameError):
            headway.diagnose(tested, groups=["hihg"])
    assert headway.diagnose(tested, groups=["high"], num_episodes=1).summary("high").episodes == 1


def test_how_heads_would_be_selected(tested):
    selected, learning, drawn = (
        headway.diagnose(tested, groups=["high"], settings=settings).summary("high")
        for settings in (
            {},
            {"planner.adaptation": "last-layer"},
            {"planner.head_selection": "random"},
        )
    )
    assert learning.chosen_error < 0.7 * selected.chosen_error
    np.testing.assert_array_equal(drawn.head_errors, selected.head_errors)
    assert drawn.wrong > selected.wrong
    with pytest.raises(ConfigError, match="cannot change here"):
        headway.diagnose(tested, settings={"model.num_heads": 2})


def test_damaged_tests_are_noticed(tested, tmp_path):
    path = Path(shutil.copytree(tested, tmp_path / "run"))
    damaged = path / "tests" / "iteration-001.safetensors"
    content = bytearray(damaged.read_bytes())
    content[-1] ^= 1
    damaged.write_bytes(content)
    with pytest.raises(RunError, match=r"iteration-001\.safetensors is damaged"):
        headway.diagnose(path)
