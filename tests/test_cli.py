"""The command line: what it passes to the library, what it prints, its exit codes."""

import dataclasses
import io
import json
import re
import subprocess
import sys

import pytest

import headway.training.evaluate
from headway import api
from headway.cli import COMMANDS, main, parse, read_seeds, read_settings
from headway.errors import ConfigError, RunError
from headway.lab import figures
from headway.lab.paper import EXPERIMENTS
from headway.training.evaluate import Evaluation, PlanningCost
from headway.training.methods import METHODS, PRESETS, make_config
from headway.training.run import EpisodeRow, RunDir
from headway.training.stopping import Terminated


def run(capsys, *words):
    """Exit code, stdout and stderr of one command."""
    try:
        code = main(words)
    except SystemExit as stop:
        code = stop.code
    captured = capsys.readouterr()
    return code, captured.out, captured.err


def without_boxes(text):
    return " ".join(text.replace("│", " ").split())


def episode(group, length, value, iteration=1):
    physics = {"length": length, "mass": 1.0}
    return EpisodeRow("tmcl", "pendulum", 3, iteration, group, physics, 0, value, 200)


ROWS = [
    episode("train", 0.5, -126.0),
    episode("train", 1.0, -131.0),
    episode("unseen", 1.5, -1041.0),
    episode("unseen", 1.5, -1141.0),
]


@pytest.fixture
def calls(monkeypatch, tmp_path):
    """What the command line asks of the library, which is replaced."""
    made = []

    def train(env, **asked):
        made.append({"env": env, **asked})
        config = make_config(env, method=asked["method"], preset=asked["preset"])
        metrics = [{"timesteps": 100}, {"timesteps": 200}]
        rows = [episode("train", 0.5, 0.0, iteration=0), *ROWS]
        return api.Run(tmp_path / "run", config, metrics, rows)

    def evaluate(run_dir, **asked):
        made.append({"run_dir": str(run_dir), **asked})
        cost = PlanningCost(300.0, 2.5e9, 0.0125)
        return Evaluation(ROWS, make_config("pendulum"), cost)

    monkeypatch.setattr(figures, "save_run_figures", lambda path: [path.parent / "a.png"])
    monkeypatch.setattr(api, "train", train)
    monkeypatch.setattr(headway.training.evaluate, "evaluate", evaluate)
    return made


@pytest.fixture
def trained(tmp_path):
    """A run directory as far as its settings go."""
    run_dir = RunDir(tmp_path / "trained")
    run_dir.begin(make_config("pendulum", preset="quick"))
    return str(run_dir.path)


def test_top_help_and_version(capsys):
    assert run(capsys, "--version")[1].startswith("headway ")
    code, out, _ = run(capsys, "--help")
    assert code == 0
    assert set(re.findall(r"• ([a-z][\w-]*) ", out)) == set(COMMANDS)


@pytest.mark.parametrize(
    ("words", "text"),
    [
        ("", "Missing subcommand"),
        ("trian", "Available subcommands: train"),
        ("train pendulum --planner.horizn 3", "--planner.horizon INT"),
        ("train pendulum --planner.horizon x", "--planner.horizon: invalid"),
        ("train pendulum --planner.optimizer.num-elites 900", "num_elites is 900, allowed: "),
    ],
)
def test_wrong_usage_exits_2_and_says_what_there_is(capsys, calls, words, text):
    code, out, err = run(capsys, *words.split())
    assert (code, out) == (2, "")
    assert text in without_boxes(err)
    assert not calls


@pytest.mark.parametrize(
    ("words", "text"),
    [
        ("train pendulm", "Did you mean 'pendulum'?"),
        ("train pendulm --help", "Did you mean 'pendulum'?"),
        ("train pendulum --method tmlc", "Did you mean 'tmcl'?"),
        ("train pendulum --preset quik", "Did you mean 'quick'?"),
        ("train hopper --env-options scale-inertia", "allowed: NAME=VALUE"),
        ("train pendulum --sim-params missing.json", "missing.json"),
        ("evaluate nowhere --json", "allowed: a run directory"),
        ("evaluate --json RUN", "--json comes first, allowed: ENV or RUN, then options"),
        ("train --seed 1 pendulum --preset quick", "--seed comes first, allowed: ENV"),
        (
            "evaluate RUN --sim-params length=1 length=2",
            "--sim-params is length=1 length=2, allowed",
        ),
    ],
)
def test_errors_are_one_line_and_exit_1(capsys, calls, trained, words, text):
    code, out, err = run(capsys, *words.replace("RUN", str(trained)).split())
    assert (code, out) == (1, "")
    assert re.fullmatch(rf"error: .*{re.escape(text)}.*\n", err)
    assert not calls


@pytest.mark.parametrize(
    ("error", "code", "said"),
    [
        (RunError("two\nlines"), 1, "error: two lines\n"),
        (KeyboardInterrupt(), 130, "interrupted; the same command goes on where this one stopped"),
        (Terminated(143), 143, "terminated; the same command goes on where this one stopped"),
    ],
)
def test_how_training_can_end(capsys, monkeypatch, error, code, said):
    def fail(*_, **__):
        raise error

    monkeypatch.setattr(api, "train", fail)
    assert run(capsys, "train", "pendulum") == (code, "", said.rstrip("\n") + "\n")


def asked(*words):
    return parse(["train", *words]).settings()


def test_settings_are_those_that_differ_from_the_preset():
    words = "--preset quick --planner.horizon 7 --fitting.epochs 20 --model.hidden-sizes 8 9"
    wanted = {"planner.horizon": 7, "model.hidden_sizes": [8, 9]}
    assert asked("pendulum", *words.split()) == wanted
    assert asked("pendulum", "--model.no-backward-net") == {"model.backward_net": False}
    switched = asked("hopper", "--env-options", "scale-inertia=on")
    assert switched["env_options"] == {"scale_inertia": True}
    words = ["gain=-2.0", "a-b=x-y", "sizes=[1,2]", 'table={"k":null}', 'text="on"']
    wanted = {"gain": -2.0, "a_b": "x-y", "sizes": [1, 2], "table": {"k": None}, "text": "on"}
    assert asked("pendulum", "--env-options", *words)["env_options"] == wanted


def test_physics_from_a_file(capsys, tmp_path):
    sets = {"train": {"length": [0.5], "mass": [1.0]}, "unseen": {}}
    path = tmp_path / "physics.json"
    path.write_text(json.dumps(sets))
    assert asked("pendulum", "--sim-params", str(path)) == {"sim_params": sets}
    for text in ("{", "[" * 100_000):
        path.write_text(text)
        code, _, err = run(capsys, "train", "pendulum", "--sim-params", str(path))
        assert code == 1
        assert "is not JSON" in err


def test_help_shows_the_values_that_settings_would_have(capsys, trained):
    for words in (["train", "pendulum", "--preset", "quick"], ["evaluate", trained]):
        lengths = []
        for option in ("--help", "--help-all"):
            code, out, err = run(capsys, *words, option)
            assert (code, err) == (0, "")
            assert "--planner.horizon INT Imagined steps. (default: 20)" in without_boxes(out)
            assert ("--planner.selection-length" in out) == (option == "--help-all")
            lengths.append(len(out))
        assert lengths[0] < lengths[1] / 2
    for command in COMMANDS:
        assert run(capsys, command, "--help")[0] == 0


def test_train_prints_a_table_the_figures_and_what_to_do_next(capsys, calls, tmp_path):
    words = "train pendulum --preset quick --seed 3 --resume-from-last-good --quiet"
    code, out, err = run(capsys, *words.split())
    assert (code, err) == (0, "")
    for text in ("training", "length 0.5", "-1,091.0 ± 50.0", "1.00", str(tmp_path / "a.png")):
        assert text in out
    assert f"headway evaluate {tmp_path / 'run'}" in out
    assert f"headway {words}" in out
    assert (calls[0]["seed"], calls[0]["run_dir"], calls[0]["settings"]) == (3, None, {})
    assert calls[0]["resume_from_last_good"] is True


def test_train_json_is_one_line(capsys, calls, tmp_path):
    code, out, _ = run(capsys, "train", "pendulum", "--json", "--preset", "quick")
    assert (code, out.count("\n")) == (0, 1)
    facts = json.loads(out)
    assert (facts["run_dir"], facts["timesteps"]) == (str(tmp_path / "run"), 200)
    train, unseen = facts["groups"]
    assert (train["episodes"], train["return_mean"]) == (2, -128.5)
    assert train["score"] == pytest.approx(1.0)
    assert unseen["score"] == pytest.approx(-50 / (1041 - 203))
    assert [part["sim_params"]["length"] for part in facts["physics"]] == [0.5, 1.0, 1.5]


def test_evaluate_passes_groups_episodes_and_the_settings_that_differ(capsys, calls, trained):
    words = "--group unseen train --episodes 5 --planner.num-candidates 50 --planner.horizon 20"
    words += " --sim-params length=2.0 mass=1 --iteration best"
    code, out, _ = run(capsys, "evaluate", trained, *words.split(), "--json")
    assert code == 0
    call, facts = calls[0], json.loads(out)
    assert (call["run_dir"], call["groups"]) == (trained, ("unseen", "train"))
    assert (call["num_episodes"], call["settings"]) == (5, {"planner.num_candidates": 50})
    assert (call["sim_params"], call["iteration"]) == ({"length": 2.0, "mass": 1.0}, "best")
    assert facts["settings"] == call["settings"]
    assert facts["planning"] == dataclasses.asdict(PlanningCost(300.0, 2.5e9, 0.0125))
    out = run(capsys, "evaluate", trained, "--iteration", "1")[1]
    assert calls[1]["iteration"] == 1
    assert "Planning took 300 candidates, 2.5 GFLOP, 12.5 ms per step." in out
    assert (calls[1]["groups"], calls[1]["num_episodes"], calls[1]["settings"]) == (None, None, {})


LISTED = {"methods": METHODS, "presets": PRESETS, "experiments": EXPERIMENTS, "envs": ["hopper"]}


@pytest.mark.parametrize(("what", "names"), LISTED.items())
def test_list(capsys, what, names):
    code, out, _ = run(capsys, "list", what)
    assert code == 0
    assert all(name in out for name in names)
    listed = json.loads(run(capsys, "list", what, "--json")[1])[what]
    assert set(names) <= {entry["name"] for entry in listed}


def test_what_a_terminal_cannot_show_is_escaped(monkeypatch):
    ascii_only = io.TextIOWrapper(io.BytesIO(), "ascii")
    monkeypatch.setattr(sys, "stdout", ascii_only)
    assert main(["list", "methods"]) == 0
    assert b"\\u2013" in ascii_only.buffer.getvalue()


def test_plot_dynamics(capsys, tmp_path):
    out_file = tmp_path / "deep" / "picture.png"
    words = ("plot-dynamics", "pendulum", "-o", str(out_file), "--json")
    code, out, _ = run(capsys, *words)
    assert code == 0
    assert json.loads(out) == {"env": "pendulum", "figure": str(out_file)}
    assert out_file.read_bytes().startswith(b"\x89PNG")


def test_seeds_are_numbers_and_ranges():
    assert read_seeds(["1", "7:9", "0:3"]) == (1, 7, 8, 0, 1, 2)
    for word in ("x", "3:3", "3:1", "-1", "0:99999999", "1:2:3"):
        with pytest.raises(ConfigError, match=r"--seeds is .*allowed"):
            read_seeds([word])


def test_settings_of_a_sweep_are_json_or_text():
    words = ["model.hidden_sizes=[8,8],[9]", "planner.head-selection=average", "a=1,2.5"]
    words += ['env_options={"x":true,"y":false},{"x":false}', "c=1, x,2.y,1e5z"]
    assert read_settings(words) == {
        "model.hidden_sizes": [[8, 8], [9]],
        "planner.head_selection": ["average"],
        "a": [1, 2.5],
        "env_options": [{"x": True, "y": False}, {"x": False}],
        "c": [1, "x", "2.y", "1e5z"],
    }

    for bad in ("a", "a=", "=1", "a=1,", "a=x,,y", "a=,", "a=[8,8", 'a={"x":true', "a=[1]2", "c=1"):
        with pytest.raises(ConfigError, match=r"--settings is"):
            read_settings(["c=1", bad])


def test_the_module_runs_and_help_loads_nothing_heavy():
    code = (
        "import sys, headway.cli\n"
        "try: headway.cli.main(['--help'])\n"
        "except SystemExit: pass\n"
        "heavy = {'jax', 'mujoco', 'gymnasium', 'matplotlib'} & set(sys.modules)\n"
        "assert not heavy, heavy\n"
    )
    subprocess.run([sys.executable, "-c", code], check=True, stdout=subprocess.DEVNULL)
    words = [sys.executable, "-m", "headway", "nonsense"]
    assert subprocess.run(words, capture_output=True, check=False).returncode == 2
