import json

import numpy as np
import pytest

import headway
from headway.cli import main
from headway.errors import ConfigError, RunError, UnknownNameError
from headway.lab import diagnose as lab
from headway.training.methods import make_config
from headway.training.run import RunDir


def files(path):
    return {file: file.read_bytes() for file in path.rglob("*") if file.is_file()}


def test_diagnose_runs_the_tests_of_a_run(reference, capsys):
    before = files(reference)
    assert main(["diagnose", str(reference), "--json", "--quiet"]) == 0
    said = json.loads(capsys.readouterr().out)
    assert [group["group"] for group in said["groups"]] == ["train", "low", "high"]
    for group in said["groups"]:
        assert group["episodes"] == 2
        assert np.shape(group["head_errors"]) == (2, 3)
        assert group["regret"] == pytest.approx(group["chosen_error"] - group["best_error"])
        assert group["average_error"] == pytest.approx(np.mean(group["head_errors"]))
        assert 0 <= group["wrong_selections"] <= 1
        inside = list(group["calibration"]["inside"].values())
        assert inside == sorted(inside)
        assert sum(physics["episodes"] for physics in group["physics"]) == 2
    assert files(reference) == before
    found = headway.diagnose(reference)
    assert json.loads(json.dumps(lab.facts(found)))["groups"] == said["groups"]
    shown = found._repr_mimebundle_([], [])  # by a notebook
    for mime in ("text/plain", "text/html"):
        assert "Calibration of the predicted variance" in shown[mime]


def test_the_tables_of_a_diagnosis_and_what_is_refused(reference, capsys):
    assert main(["diagnose", str(reference)]) == 0
    out = capsys.readouterr().out
    for title in ("Head selection", "Error of each head", "Calibration of the predicted variance"):
        assert title in out
    for words, said in (("--group lo", "Did you mean 'low'?"), ("--episodes 0", "episodes is 0")):
        assert main(["diagnose", str(reference), *words.split(), "--quiet"]) == 1
        assert said in capsys.readouterr().err


@pytest.mark.parametrize(
    ("method", "words", "said"),
    [
        ("random", [], "a run of random, which has no prediction heads"),
        ("tmcl", [], "has no finished iteration yet"),
        (None, [], "config.json is missing"),
    ],
)
def test_only_trained_runs_with_heads_are_diagnosed(tmp_path, method, words, said, capsys):
    if method:
        RunDir(tmp_path).begin(make_config("pendulum", method=method, preset="smoke"))
    assert main(["diagnose", str(tmp_path), "--quiet", *words]) == 1
    assert said in capsys.readouterr().err


def test_the_tests_of_a_run_are_not_run_again(reference, two_iterations, monkeypatch):
    run = RunDir(reference)
    returns = [t.returns for found in run.tests().values() for t in found]
    assert returns == [row.episode_return for row in run.evaluation() if row.iteration == 2]
    with monkeypatch.context() as patched:
        patched.setattr(lab, "evaluate", lambda *args, **kwargs: pytest.fail("tests were run"))
        found = headway.diagnose(reference)
        counts = {group: len(episodes) for group, episodes in found.episodes.items()}
        assert counts == {"train": 2, "low": 2, "high": 2}
        assert list(headway.diagnose(reference, groups=["high"]).episodes) == ["high"]
        assert list(headway.diagnose(two_iterations).episodes) == ["low", "high"]  # a stopped run
        with pytest.raises(UnknownNameError):
            headway.diagnose(reference, groups=["hihg"])
    again = headway.diagnose(reference, groups=["high"], num_episodes=1)
    assert again.summary("high").episodes == 1


def test_how_heads_would_be_selected(reference):
    changes = {}, {"planner.adaptation": "last-layer"}
    selected, learning = (
        headway.diagnose(reference, groups=["high"], settings=settings).summary("high")
        for settings in changes
    )
    assert learning.chosen_error < 0.7 * selected.chosen_error
    with pytest.raises(ConfigError, match="cannot change here"):
        headway.diagnose(reference, settings={"model.num_heads": 2})


def test_damaged_tests_are_noticed(root):
    damaged = root / "tests/iteration-001.safetensors"
    content = bytearray(damaged.read_bytes())
    content[-1] ^= 1
    damaged.write_bytes(content)
    with pytest.raises(RunError, match=r"iteration-001\.safetensors is damaged"):
        headway.diagnose(root)
