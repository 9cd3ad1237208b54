"""Several seeds in one program: equal to separate runs, each a run of its own, none in the way."""

import json
import os
import shutil
import signal
import sys
from pathlib import Path

import numpy as np
import pytest

import headway
from headway.cli import main
from headway.errors import BusyError, ConfigError, DivergenceError, SeedsError
from headway.experiment import training
from headway.experiment.learners import multi_headed
from headway.experiment.methods import make_config
from headway.experiment.progress import Progress
from headway.experiment.seeds import train_seeds
from headway.models.meeting import Meeting, Program, seat_here
from headway.storage import arrays
from headway.storage.run_dir import RunDir
from headway.storage.run_lock import locked

sys.path.append(str(Path(__file__).parent.parent / "chaos"))
import killing

TOLERANCE = 1e-4  # of parameters and losses; found: 2e-7
QUICK_TO_COMPILE = {
    **killing.TINY,
    "fitting.warmup_iterations": 0,
    "model.hidden_sizes": (8,),
    "model.context_size": 2,
    "model.context_hidden_sizes": (4,),
    "model.backward_net": False,
}


def config_of(seed, method="tmcl", settings=None):
    return make_config(
        "pendulum", method=method, preset="smoke", seed=seed, settings=settings or QUICK_TO_COMPILE
    )


def places(folder, seeds=(0, 1)):
    return {seed: folder / f"seed{seed}" for seed in seeds}


def files(path):
    return {str(p.relative_to(path)) for p in path.rglob("*") if not {"tensorboard"} & set(p.parts)}


def assert_same_run(found, expected):
    """The same run within rounding; planning must not have amplified it in so few steps."""
    assert files(found) == files(expected)
    assert (found / "config.json").read_bytes() == (expected / "config.json").read_bytes()
    runs = RunDir(found), RunDir(expected)
    for run in runs:
        run.check()
    first = [run.iteration_data(0) for run in runs]
    for one, other in zip(*first, strict=True):  # acted at random
        np.testing.assert_array_equal(one.obs, other.obs)
        np.testing.assert_array_equal(one.action, other.action)
    checkpoints = [arrays.load_arrays(run.checkpoint(len(run.metrics()) - 1)) for run in runs]
    for name, values in checkpoints[0].items():
        np.testing.assert_allclose(
            np.asarray(values, np.float32),
            np.asarray(checkpoints[1][name], np.float32),
            rtol=TOLERANCE,
            atol=TOLERANCE,
            err_msg=name,
        )
    for one, other in zip(*(run.metrics() for run in runs), strict=True):
        assert one["timesteps"] == other["timesteps"]
        np.testing.assert_allclose(one["fitting"]["loss"], other["fitting"]["loss"], TOLERANCE)
        np.testing.assert_allclose(
            one["collection"]["returns"], other["collection"]["returns"], 1e-3
        )
    episodes = [[(r.group, r.episode, r.length) for r in run.evaluation()] for run in runs]
    assert episodes[0] == episodes[1]


@pytest.fixture(scope="module")
def alone(tmp_path_factory):
    """Separate runs."""
    found = places(tmp_path_factory.mktemp("alone"))
    for seed, path in found.items():
        training.train_run(config_of(seed), path)
    return found


def test_seeds_together_equal_separate_runs(alone, tmp_path, monkeypatch):
    mapped, together = [], Program.together
    monkeypatch.setattr(Program, "together", lambda *args: mapped.append(0) or together(*args))
    runs = train_seeds(config_of(9), places(tmp_path))
    assert [run.path for run in runs] == list(places(tmp_path).values())
    for seed, run in enumerate(runs):
        assert_same_run(run.path, alone[seed])
    # 3 epochs and 3 tests of 6 steps in every iteration but the last's 4; 6 planned steps.
    collected, fitted, tested = 2 * 6, 3 * 3, (2 + 2 + 3) * 6
    assert len(mapped) == collected + fitted + tested


@pytest.mark.slow
@pytest.mark.parametrize("method", ["tmcl", "ria", "grbal", "rebal", "tmcl-bayes", "pets-cadm"])
def test_every_kind_of_model_trains_together(method, tmp_path):
    train_seeds(config_of(0, method, killing.TINY), places(tmp_path / "together"))
    training.train_run(config_of(1, method, killing.TINY), tmp_path / "alone")
    assert_same_run(tmp_path / "together/seed1", tmp_path / "alone")


class At(Progress):
    """Does something when a run tells of a number of epochs."""

    def __init__(self, epochs, action):
        self.epochs, self.action = epochs, action
        self.said = []

    def advance(self, amount=1, **values):
        self.epochs -= bool(values)
        if self.epochs == 0 and values:
            self.action()

    def message(self, text):
        self.said.append(text)


def interrupted(folder):
    """Two seeds, stopped by Ctrl-C in the second iteration's fit."""
    stop = At(8, lambda: os.kill(os.getpid(), signal.SIGINT))
    with pytest.raises(KeyboardInterrupt):
        train_seeds(config_of(0), places(folder), stop)
    assert [RunDir(path).finished_iterations for path in places(folder).values()] == [1, 1]
    assert all((path / "partial").is_dir() for path in places(folder).values())


def test_an_interrupted_command_goes_on_also_where_one_run_was_finished_alone(alone, tmp_path):
    interrupted(tmp_path)
    training.train_run(config_of(0), tmp_path / "seed0")
    assert_same_run(tmp_path / "seed0", alone[0])
    finished = {p: p.stat().st_mtime_ns for p in (tmp_path / "seed0/checkpoints").iterdir()}
    train_seeds(config_of(0), places(tmp_path))
    assert_same_run(tmp_path / "seed1", alone[1])
    assert finished == {p: p.stat().st_mtime_ns for p in finished}  # nothing is done twice


def test_runs_that_were_begun_alone_are_finished_together(alone, tmp_path):
    for seed, path in places(tmp_path).items():
        shutil.copytree(alone[seed], path)
    for newest in (tmp_path / "seed1/manifests").glob("*002.json"):
        newest.unlink()  # as if it had been killed before its last iteration counted
    train_seeds(config_of(0), places(tmp_path))
    for seed, path in places(tmp_path).items():
        assert_same_run(path, alone[seed])


def failing(monkeypatch, *, times):
    """Let the fourth and later epochs of the second run diverge; returns the step sizes."""
    plain, rates = multi_headed.fit_blocks, {}

    def fit_blocks(state, setup, blocks, *, independent):
        here = seat_here()
        mine = rates.setdefault(here, [])
        mine.append(setup.config.learning_rate)
        state, found = plain(state, setup, blocks, independent=independent)
        if here is seats[1] and 4 <= len(mine) < 4 + times:
            return state, found._replace(skipped=found.updates)
        return state, found

    seats, take_seat = [], Meeting.take_seat

    def noted(self):
        seats.append(take_seat(self))
        return seats[-1]

    monkeypatch.setattr(Meeting, "take_seat", noted)
    monkeypatch.setattr(multi_headed, "fit_blocks", fit_blocks)
    return lambda: [rates[seat] for seat in seats]


def test_a_seed_that_diverges_for_good_leaves_the_others_to_go_on(alone, tmp_path, monkeypatch):
    heard = At(-1, None)
    with monkeypatch.context() as patch:
        failing(patch, times=99)
        patch.setattr(training, "SLOWER", 1.0)  # the same steps, so nothing new to compile
        with pytest.raises(SeedsError, match=r"1 of 2 seeds stopped.* seed 1: epoch 0") as error:
            train_seeds(config_of(0), places(tmp_path), heard)
    assert isinstance(error.value.failures[1], DivergenceError)
    told = [text for text in heard.said if "The other seeds go on" in text]
    assert [text.startswith("seed 1: stopped") for text in told] == [True]
    assert_same_run(tmp_path / "seed0", alone[0])
    assert RunDir(tmp_path / "seed1").finished_iterations == 1
    train_seeds(config_of(0), places(tmp_path))
    assert_same_run(tmp_path / "seed1", alone[1])


@pytest.mark.slow
def test_a_seed_that_goes_back_an_epoch_does_so_by_itself(tmp_path, monkeypatch):
    rates = failing(monkeypatch, times=1)
    train_seeds(config_of(0), places(tmp_path))
    usual = config_of(0).fitting.learning_rate
    np.testing.assert_allclose(rates()[0], [usual] * 9)
    np.testing.assert_allclose(rates()[1], [usual] * 4 + [usual / 4] * 3 + [usual] * 3)
    assert [RunDir(p).metrics()[1]["fitting"]["rollbacks"] for p in places(tmp_path).values()] == [
        0,
        1,
    ]


def test_what_is_in_use_is_refused_before_anything_begins(tmp_path):
    busy = tmp_path / "seed1"
    busy.mkdir()
    with locked(busy), pytest.raises(BusyError, match="seed1 is being trained"):
        train_seeds(config_of(0), places(tmp_path))
    assert not (tmp_path / "seed0/config.json").exists()


def test_plans_of_several_processes_are_refused(tmp_path):
    config = make_config("pendulum", preset="smoke", settings={"planner.devices": "all"})
    with pytest.raises(ConfigError, match=r"planner.devices is 'all', allowed with several seeds"):
        train_seeds(config, places(tmp_path))


def test_runs_that_learn_nothing_go_one_after_another(tmp_path):
    heard = At(-1, None)
    settings = {"collection.episode_length": 6}
    runs = headway.train_seeds(
        "pendulum",
        seeds=[4, 2],
        method="random",
        preset="smoke",
        settings=settings,
        run_dir=tmp_path,
        progress=heard,
    )
    assert [run.path for run in runs] == [tmp_path / "seed4", tmp_path / "seed2"]
    assert [run.config.seed for run in runs] == [4, 2]
    assert heard.said == [f"seed {s} by itself, because random learns nothing" for s in (4, 2)]
    training.train_run(
        make_config("pendulum", method="random", preset="smoke", seed=2, settings=settings),
        tmp_path / "alone",
    )
    returns = [
        [row.episode_return for row in RunDir(tmp_path / name).evaluation()]
        for name in ("seed2", "alone")
    ]
    assert returns[0] == returns[1]


@pytest.mark.parametrize("seeds", [[], [1, 1]])
def test_seeds_must_be_there_and_differ(seeds):
    with pytest.raises(ConfigError, match=r"seeds is .*, allowed: one or more, each once"):
        headway.train_seeds("pendulum", seeds=seeds)


def test_the_command_line(tmp_path, capsys):
    words = ["train", "pendulum", "--method", "random", "--preset", "smoke", "--quiet"]
    words += ["--collection.episode-length", "5", "--run-dir", str(tmp_path)]
    assert main([*words, "--seeds", "0:2", "--json"]) == 0
    runs = json.loads(capsys.readouterr().out)["runs"]
    assert [(run["seed"], run["run_dir"]) for run in runs] == [
        (seed, str(path)) for seed, path in places(tmp_path).items()
    ]
    assert main([*words, "--seeds", "0:2"]) == 0
    shown = capsys.readouterr().out
    assert "seeds 0, 1" in " ".join(shown.split())
    assert all(f"headway evaluate {path}" in shown for path in places(tmp_path).values())
    assert main([*words, "--seeds", "0:2", "--seed", "1"]) == 2
    assert "--seed and --seeds are given" in capsys.readouterr().err
