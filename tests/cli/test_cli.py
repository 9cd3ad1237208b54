import dataclasses
import json
import re
import subprocess
import sys

import pytest

from headway import api
from headway.cli import main
from headway.cli.commands import COMMANDS, parse_train
from headway.errors import RunError
from headway.experiment.evaluation import PlanningCost
from headway.experiment.methods import METHODS, PRESETS, make_config
from headway.settings import flatten, override, to_dict
from headway.storage.interrupts import Terminated
from headway.storage.run_dir import RunDir
from headway.storage.tables import EpisodeRow


def run(capsys, *words):
    """Exit code, stdout and stderr of one command."""
    try:
        code = main(words)
    except SystemExit as stop:
        code = stop.code
    captured = capsys.readouterr()
    return code, captured.out, captured.err


def episode(group, length, value, episode=0):
    return EpisodeRow(
        "tmcl", "pendulum", 3, 1, group, {"length": length, "mass": 1.0}, episode, value, 200
    )


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
        stale = dataclasses.replace(ROWS[0], iteration=0, episode_return=0.0)
        return api.Run(tmp_path / "run", config, metrics, [stale, *ROWS], [tmp_path / "a.png"])

    def evaluate(run_dir, **asked):
        made.append({"run_dir": run_dir, **asked})
        cost = PlanningCost(300.0, 2.5e9, 0.0125)
        return api.Evaluation(ROWS, make_config("pendulum"), cost)

    monkeypatch.setattr(api, "train", train)
    monkeypatch.setattr(api, "evaluate", evaluate)
    return made


@pytest.fixture
def trained(tmp_path):
    """A run directory as far as its settings go."""
    run_dir = RunDir(tmp_path / "trained")
    run_dir.create_or_resume(make_config("pendulum", preset="quick"))
    return str(run_dir.path)


def test_top_help_and_version(capsys):
    assert run(capsys, "--version")[1].startswith("headway ")
    code, out, _ = run(capsys, "--help")
    assert code == 0
    listed = re.findall(r"^  ([a-z][\w-]*) ", out, flags=re.MULTILINE)
    assert sorted(listed) == sorted(COMMANDS)


USAGE = [
    ([], "missing command"),
    (["trian"], "Did you mean 'train'?"),
    (["train"], "missing argument ENV"),
    (["train", "pendulum", "more"], "unexpected argument 'more'"),
    (["train", "pendulum", "--planner.horizn", "3"], "Did you mean '--planner.horizon'?"),
    (["train", "pendulum", "--hidden-sizes", "3"], "Did you mean '--model.hidden-sizes'?"),
    (["train", "pendulum", "--planner.horizon", "x"], "is 'x', allowed: a whole number"),
    (["train", "pendulum", "--planner.horizon"], "Missing value for argument"),
    (["train", "pendulum", "--fitting.learning-rate=x"], "is 'x', allowed: a number"),
    (["train", "pendulum", "--model.hidden-sizes", "8", "x"], "is '8 x', allowed: whole numbers"),
    (["train", "pendulum", "--fitting.oracle", "trajectroy"], "Did you mean 'trajectory'?"),
    (["evaluate"], "missing argument RUN"),
    (["evaluate", "run", "--episodes", "many"], "is 'many', allowed: a whole number"),
    (
        ["evaluate", "run", "--planner.num-candidate", "9"],
        "Did you mean '--planner.num-candidates'?",
    ),
    (["evaluate", "run", "--planner.optimizer", "icm"], "Did you mean 'icem'?"),
    (["evaluate", "run", "--model.num-heads", "9"], "unknown option '--model.num-heads'"),
    (["list", "env"], "Did you mean 'envs'?"),
    (["plot-dynamics", "pendulum", "--num-states", "0"], "--num-states is 0"),
]


@pytest.mark.parametrize(("words", "text"), USAGE)
def test_wrong_usage_is_one_line_and_exits_2(capsys, calls, words, text):
    code, out, err = run(capsys, *words)
    assert (code, out) == (2, "")
    assert err.startswith("error: ")
    assert err.count("\n") == 1
    assert text in err
    assert not calls


ERRORS = [
    (["train", "pendulm"], "Did you mean 'pendulum'?"),
    (["train", "pendulm", "--help"], "Did you mean 'pendulum'?"),
    (["train", "pendulum", "--method", "tmlc"], "Did you mean 'tmcl'?"),
    (["train", "pendulum", "--preset", "quik"], "Did you mean 'quick'?"),
    (["train", "pendulum", "--env-options", "nothing"], "unknown pendulum option"),
    (["train", "pendulum", "--sim-params", "missing.json"], "missing.json"),
]


@pytest.mark.parametrize(("words", "text"), ERRORS)
def test_errors_are_one_line_and_exit_1(capsys, calls, words, text):
    code, out, err = run(capsys, *words)
    assert (code, out) == (1, "")
    assert err.startswith("error: ")
    assert err.count("\n") == 1
    assert text in err
    assert not calls


def test_values_out_of_range_are_left_to_the_library(capsys):
    code, out, err = run(capsys, "train", "pendulum", "--planner.num-elites", "900")
    assert (code, out) == (1, "")
    assert "num_elites is 900, allowed: at most num_candidates (200)" in err


def test_errors_of_several_lines_are_joined(capsys, monkeypatch, trained):
    def fail(*_, **__):
        raise RunError("two\nlines")

    monkeypatch.setattr(api, "evaluate", fail)
    assert run(capsys, "evaluate", trained) == (1, "", "error: two lines\n")


def test_evaluating_what_is_no_run(capsys, tmp_path):
    code, out, err = run(capsys, "evaluate", str(tmp_path / "none"), "--json")
    assert (code, out) == (1, "")
    assert "allowed: a run directory" in err


@pytest.mark.parametrize(("command", "advice"), [("train", "goes on where"), ("evaluate", "")])
def test_ctrl_c_exits_130_with_one_line(capsys, monkeypatch, trained, command, advice):
    def interrupt(*_, **__):
        raise KeyboardInterrupt

    monkeypatch.setattr(api, command, interrupt)
    code, out, err = run(capsys, command, {"train": "pendulum", "evaluate": trained}[command])
    assert (code, out) == (130, "")
    assert err.count("\n") == 1
    assert advice in err


def test_sigterm_exits_143_with_one_line(capsys, monkeypatch):
    def terminate(*_, **__):
        raise Terminated(143)

    monkeypatch.setattr(api, "train", terminate)
    code, out, err = run(capsys, "train", "pendulum")
    assert (code, out) == (143, "")
    assert err == "terminated; the same command goes on where this one stopped\n"


def test_train_passes_on_what_to_do_about_damage_and_limits(capsys, calls):
    run(capsys, "train", "pendulum", "--preset", "smoke", "--resume-from-last-good")
    run(capsys, "train", "pendulum", "--preset", "smoke", "--ignore-limits")
    asked = [(call["resume_from_last_good"], call["ignore_limits"]) for call in calls]
    assert asked == [(True, False), (False, True)]


def test_settings_are_those_that_differ_from_the_preset():
    words = (
        "pendulum --preset quick --planner.horizon 7 --fitting.epochs 20 --model.hidden_sizes 8 9"
    )
    arguments, settings = parse_train(words.split())
    assert (arguments.env, arguments.preset) == ("pendulum", "quick")
    assert settings == {"planner.horizon": 7, "model.hidden_sizes": (8, 9)}


def test_flags_and_options_may_come_before_the_environment():
    words = "--model.no-backward-net --seed 4 --method=mcl pendulum --fitting.learning-rate=0.01"
    arguments, settings = parse_train(words.split())
    assert (arguments.env, arguments.method, arguments.seed) == ("pendulum", "mcl", 4)
    assert settings == {"model.backward_net": False, "fitting.learning_rate": 0.01}


def test_physics_from_a_file(tmp_path):
    sets = {"train": {"length": [0.5], "mass": [1.0]}, "unseen": {}}
    path = tmp_path / "physics.json"
    path.write_text(json.dumps(sets))
    _, settings = parse_train(["pendulum", "--sim-params", str(path)])
    found = override(make_config("pendulum"), settings).sim_params
    assert found is not None
    assert found.to_dict() == sets


def test_damaged_physics_file(capsys, tmp_path):
    path = tmp_path / "physics.json"
    for text in ("{", "[" * 100_000, '{"train": {"length": [NaN]}}', '{"a": 1, "a": 2}'):
        path.write_text(text)
        code, _, err = run(capsys, "train", "pendulum", "--sim-params", str(path))
        assert code == 1
        assert "is not JSON" in err
        assert err.count("\n") == 1


def test_help_shows_the_defaults_of_the_preset(capsys):
    code, out, err = run(capsys, "train", "pendulum", "--preset", "quick", "--help")
    assert (code, err) == (0, "")
    text = " ".join(out.replace("│", " ").split())
    assert "--planner.horizon INT Imagined steps. (default: 20)" in text
    assert "(default: quick)" in text
    assert run(capsys, "train", "--help")[0] == 0


def test_train_prints_a_table_the_figures_and_what_to_do_next(capsys, calls, tmp_path):
    words = ("train", "pendulum", "--preset", "quick", "--seed", "3", "--quiet")
    code, out, err = run(capsys, *words)
    assert (code, err) == (0, "")
    for text in ("training", "length 0.5 m", "-1,091.0 ± 50.0", "1.00", str(tmp_path / "a.png")):
        assert text in out
    assert f"headway evaluate {tmp_path / 'run'}" in out
    assert "headway train pendulum --preset quick --seed 3 --quiet" in out
    assert calls[0]["seed"] == 3
    assert calls[0]["run_dir"] is None


def test_train_json_is_one_line(capsys, calls, tmp_path):
    code, out, _ = run(capsys, "train", "pendulum", "--json", "--preset", "quick")
    assert code == 0
    assert out.count("\n") == 1
    facts = json.loads(out)
    assert facts["run_dir"] == str(tmp_path / "run")
    assert facts["timesteps"] == 200
    train, unseen = facts["groups"]
    assert (train["episodes"], train["return_mean"]) == (2, -128.5)
    assert train["score"] == pytest.approx(1.0)
    assert unseen["score"] == pytest.approx(-50 / (1041 - 203))
    assert [part["sim_params"]["length"] for part in facts["physics"]] == [0.5, 1.0, 1.5]


def test_evaluate_passes_groups_and_episodes(capsys, calls, trained):
    words = ("evaluate", trained, "--group", "unseen", "train", "--episodes", "5", "--json")
    code, out, _ = run(capsys, *words)
    assert code == 0
    assert json.loads(out)["run_dir"] == trained
    assert calls[0]["groups"] == ("unseen", "train")
    assert calls[0]["num_episodes"] == 5
    run(capsys, "evaluate", trained)
    assert calls[1]["groups"] is None
    assert calls[1]["num_episodes"] is None
    assert calls[1]["settings"] == {}


def test_evaluate_passes_the_settings_that_differ_from_the_runs(capsys, calls, trained):
    words = "--planner.num-candidates 50 --planner.horizon 20 --evaluation.seed 7 --json"
    code, out, _ = run(capsys, "evaluate", trained, *words.split())
    assert code == 0
    assert calls[0]["settings"] == {"planner.num_candidates": 50, "evaluation.seed": 7}
    facts = json.loads(out)
    assert facts["settings"] == calls[0]["settings"]
    assert facts["planning"] == {
        "evaluations_per_step": 300.0,
        "flop_per_step": 2.5e9,
        "seconds_per_step": 0.0125,
    }


def test_evaluate_prints_what_planning_took(capsys, calls, trained):
    code, out, _ = run(capsys, "evaluate", trained)
    assert code == 0
    assert "Planning took 300 candidates, 2.5 GFLOP, 12.5 ms per step." in out


def test_help_of_evaluate_shows_the_runs_settings(capsys, trained):
    code, out, err = run(capsys, "evaluate", trained, "--help")
    assert (code, err) == (0, "")
    text = " ".join(out.replace("│", " ").split())
    assert "--planner.horizon INT Imagined steps. (default: 20)" in text
    assert run(capsys, "evaluate", "--help")[0] == 0


@pytest.mark.parametrize(
    ("what", "names"), [("methods", METHODS), ("presets", PRESETS), ("envs", ["pendulum"])]
)
def test_list(capsys, what, names):
    code, out, _ = run(capsys, "list", what)
    assert code == 0
    assert all(name in out for name in names)
    code, out, _ = run(capsys, "list", what, "--json")
    assert out.count("\n") == 1
    listed = [entry["name"] for entry in json.loads(out)[what]]
    assert set(names) <= set(listed)


def test_settings_of_methods_are_those_that_differ(capsys):
    entries = json.loads(run(capsys, "list", "methods", "--json")[1])["methods"]
    usual = flatten(to_dict(make_config("pendulum")))
    assert all(usual[n] != value for entry in entries for n, value in entry["settings"].items())
    by_name = {entry["name"]: entry["settings"] for entry in entries}
    assert by_name["cadm"]["model.context_at"] == "input"


@pytest.mark.parametrize(
    ("words", "says"),
    [
        (["sweep"], "for example planner.horizon=10,20. (default: none)"),
        (["reproduce"], "for example collection.num_iterations=3. (default: none)"),
        (["train", "--preset", "quick"], "Name ENV first"),
    ],
)
def test_help_says_what_is_not_given(capsys, words, says):
    code, out, _ = run(capsys, *words, "--help")
    assert code == 0
    assert says in " ".join(out.replace("│", " ").split())


def test_results_print_in_a_line(calls):
    trained = api.train("pendulum", method="tmcl", preset="quick")
    text = repr(trained)
    assert text.startswith(f"Run({str(trained.path)!r}: tmcl on pendulum, seed 0, 2 iterations; ")
    assert "train -128.5" in text  # without the earlier iteration
    tested = repr(api.evaluate(trained.path))
    assert re.fullmatch(
        r"Evaluation\(tmcl on pendulum, 4 episodes; train -128.5 \(score \d.\d\d\);"
        r" unseen -1,091.0 \(score -\d.\d\d\)\)",
        tested,
    )
    assert "\n" not in text + tested


def test_plot_dynamics(capsys, tmp_path):
    out_file = tmp_path / "deep" / "picture.png"
    words = ("plot-dynamics", "pendulum", "-o", str(out_file), "--num-states", "5", "--json")
    code, out, _ = run(capsys, *words)
    assert code == 0
    assert json.loads(out) == {"env": "pendulum", "figure": str(out_file)}
    assert out_file.read_bytes().startswith(b"\x89PNG")


def test_the_module_runs_and_help_loads_nothing_heavy():
    code = (
        "import sys, headway.cli\n"
        "assert headway.cli.main(['--help']) == 0\n"
        "heavy = {'jax', 'mujoco', 'gymnasium', 'matplotlib', 'tyro'} & set(sys.modules)\n"
        "assert not heavy, heavy\n"
    )
    subprocess.run([sys.executable, "-c", code], check=True, stdout=subprocess.DEVNULL)
    words = [sys.executable, "-m", "headway", "nonsense"]
    done = subprocess.run(words, capture_output=True, text=True, check=False)
    assert done.returncode == 2
    assert done.stderr.startswith("error: unknown command")
