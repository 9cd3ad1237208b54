"""Environments that hang, crash, change or end at once, in collection and in tests."""

import re

import gymnasium
import killing
import numpy as np
import pytest
from killing import Listening

import misbehaving
from headway import envs, task
from headway.envs.classic import PendulumTask
from headway.errors import BadEnvironmentError
from headway.experiment import training
from headway.experiment.rollouts import Arena, Episode, random_policy, run_episodes
from headway.experiment.testing import run_tests
from headway.sim_params import SimParamSets
from headway.storage.interrupts import StopRequest
from headway.task import EnvSpec, register

FAR = 5.0
"""Physics of the tests only."""
PROCESSES = {"collection.env_processes": True, "collection.step_timeout_s": 20.0}


@pytest.fixture
def drift():
    """Registers an environment that misbehaves in some way; may be called again."""

    def make(how="", **named):
        gymnasium.registry.pop("own/Drift-v0", None)
        gymnasium.register("own/Drift-v0", "misbehaving:Drift", kwargs={"how": how, **named})

    make()
    sets = SimParamSets({"drift": (0.5, 1.0)}, {"far": {"drift": (FAR,)}})
    register(EnvSpec("drift", "own/Drift-v0", PendulumTask, sets, 6, {"drift": 0.5}))
    yield make
    del gymnasium.registry["own/Drift-v0"], task._registered["drift"]


def config(**settings):
    return killing.tiny_config("drift", **settings)


@pytest.fixture(scope="module")
def sound(tmp_path_factory):
    """A run without any misbehaviour, trained when it is first asked for."""
    path = tmp_path_factory.mktemp("sound") / "run"

    def result():
        if not path.exists():
            training.train_run(config(), path)
        return killing.result(path, without=["config.json"])

    return result


def test_a_run_with_processes_equals_one_without(reference, tmp_path):
    settings = killing.tiny_config(**PROCESSES)
    run = training.train_run(settings, tmp_path / "run")
    assert run.config().collection.env_processes
    found, wanted = (killing.result(p, without=["config.json"]) for p in (run.path, reference))
    assert found == wanted


def test_what_hangs_is_dropped_or_stops_the_run_and_loses_nothing(drift, sound, tmp_path):
    wanted = sound()
    hanging = {**PROCESSES, "collection.step_timeout_s": 1.0}
    drift("hang_in_c", at=3, mark=str(tmp_path / "once"))
    heard = Listening()
    run = training.train_run(config(**hanging), tmp_path / "dropped", heard)
    (said,) = heard.said
    where = r"drift broke at step 3 under {'drift': \d.\d}"
    assert re.fullmatch(
        rf"{where}: did not answer to step within 1 s; the episode is dropped\.", said
    )
    whole = config().collection.num_episodes
    assert [row["collection"]["episodes"] for row in run.metrics()] == [whole - 1, whole, whole]

    (tmp_path / "once").unlink()
    strict = config(**hanging, **{"collection.max_bad_episodes": 0})
    with pytest.raises(BadEnvironmentError, match=f"1 episodes broke, allowed: 0 .*{where}: did"):
        training.train_run(strict, tmp_path / "run")
    training.train_run(config(), tmp_path / "run")  # in one process, now that it is mended
    assert killing.result(tmp_path / "run", without=["config.json"]) == wanted


def test_tests_that_break_stop_the_run_until_they_may_be_left_out(drift, sound, tmp_path):
    wanted = sound()
    drift("give_up", drift=FAR)
    says = r"2 episodes broke, allowed: 0 \(evaluation.max_bad_episodes\), .*: drift broke at step"
    with pytest.raises(BadEnvironmentError, match=says):
        training.train_run(config(), tmp_path / "run")
    drift()
    training.train_run(config(), tmp_path / "run")  # what broke was not kept
    assert killing.result(tmp_path / "run", without=["config.json"]) == wanted

    number = config().evaluation.num_episodes
    drift("give_up", drift=FAR, mark=str(tmp_path / "once"))
    heard = Listening()
    lenient = config(**{"evaluation.max_bad_episodes": 1})
    run = training.train_run(lenient, tmp_path / "left out", heard)
    assert len(heard.said) == 1
    assert [row["evaluation"]["far"]["episodes"] for row in run.metrics()] == [
        number - 1,
        number,
        number,
    ]
    whole, left = (
        [(row.iteration, row.group, row.episode) for row in one.evaluation()]
        for one in (training.RunDir(tmp_path / "run"), run)
    )
    # The first one of the group broke; the others keep their numbers.
    assert [row for row in whole if row != (0, "far", 0)] == left
    assert number > 1
    (tmp_path / "once").unlink()
    settings = {**PROCESSES, "evaluation.max_bad_episodes": 1}
    again = run_tests(run.path, groups=["far"], settings=settings).trajectories
    assert len(again["far"]) == number - 1
    drift("give_up", drift=FAR)  # all of a group
    lenient = config(**{"evaluation.max_bad_episodes": 99})
    with pytest.raises(BadEnvironmentError, match="and not all"):
        training.train_run(lenient, tmp_path / "none")


STOPS = [
    ("shrink", r"drift at step 3: an environment returned obs of shape \(2,\), allowed: \(3,\)"),
    ("speak", r"drift returned obs of .* type <U\d+ at step \d, allowed: numbers"),
    ("lose_the_reward", "returned the reward None, allowed: a number"),
    ("fail", "drift raised ZeroDivisionError at step 3: a simulator failed"),
    ("change_spaces", "drift at reset: .* has the .* space .*allowed: .* in every episode"),
    ("change_actions", "drift at reset: .* has the .* space .*allowed: .* in every episode"),
]


@pytest.mark.parametrize("where", ["collection", "tests"])
@pytest.mark.parametrize(("how", "says"), STOPS, ids=[how for how, _ in STOPS])
def test_what_cannot_be_trusted_stops_the_run_with_the_reason(where, how, says, drift, tmp_path):
    """In either place, with what was done before saved; mended, the same command goes on."""
    at = 0 if how.startswith("change") else 3
    drift(how, at=at, **({"drift": FAR} if where == "tests" else {}))
    with pytest.raises(BadEnvironmentError, match=says) as caught:
        training.train_run(config(), tmp_path / "run")
    assert "\n" not in str(caught.value)
    run = training.RunDir(tmp_path / "run")
    parts = run.partial(StopRequest())
    parts.open()
    assert (parts.load("collect") is not None) == (where == "tests")
    drift()
    training.train_run(config(), tmp_path / "run")
    assert len(run.metrics()) == 3


@pytest.mark.parametrize(("how", "length"), [("end", 1), ("cut", 1), ("count", 6)])
def test_episodes_that_end_at_once_and_other_kinds_of_numbers_are_used(
    how, length, drift, tmp_path
):
    """Whole numbers are numbers; and one transition is an episode, to learn from and to test."""
    drift(how, at=1)
    run = training.train_run(config(), tmp_path / "run")
    for iteration in range(3):
        assert {len(t) for t in run.iteration_data(iteration)} == {length}
    assert {row.length for row in run.evaluation()} == {length}
    assert {t.terminated for t in run.iteration_data(0)} == {how == "end"}
    assert all(np.isfinite(row["fitting"]["loss"]) for row in run.metrics())


@pytest.mark.parametrize("separate", [False, True])
def test_an_episode_that_mujoco_gives_up_is_left_out(separate, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)  # MuJoCo leaves a log there
    sizes = {"collection.episode_length": 4, "collection.num_episodes": 3}
    arena = Arena.make(killing.tiny_config("half-cheetah", **sizes))
    if separate:
        arena.vector.close()
        one = [lambda: envs.make("half-cheetah", max_episode_steps=4)] * arena.vector.num_envs
        vector = envs.SequentialVectorEnv(one, autoreset_mode="Disabled")
        object.__setattr__(arena, "vector", vector)
    reset = arena.vector.reset

    def diverging(**asked):
        found = reset(**asked)
        if separate:
            env = arena.vector.envs[1].unwrapped
            state = env.get_state()
            state[9:18] = 1e12
            env.set_state(state)
        else:
            state = arena.vector.get_state(1)
            state[9:18] = 1e12
            arena.vector.set_state(1, state)
        return found

    monkeypatch.setattr(arena.vector, "reset", diverging)
    physics = arena.sim_params.group("train")[0]
    episodes = [Episode(physics, seed) for seed in range(3)]
    found = run_episodes(arena, episodes, random_policy(arena, np.random.default_rng(0)))
    assert found.broken.keys() == {1}
    assert "broke at step 1 under" in found.broken[1]
    assert "the simulation of half-cheetah diverged" in found.broken[1]
    assert [len(t) for t in found.trajectories] == [4, 4]
    assert found.numbers == [0, 2]
    arena.close()


def test_the_environment_that_misbehaves_is_sound_when_it_does_not():
    """Else the tests above would test something else."""
    env = misbehaving.Drift()
    first, _ = env.reset(seed=1, options={"sim_params": {"drift": 2.0}})
    obs, reward, ends, cut, _ = env.step(np.ones(1, np.float32))
    assert env.observation_space.contains(obs)
    assert (reward, ends, cut) == (1.0, False, False)
    assert (obs != first).all()
