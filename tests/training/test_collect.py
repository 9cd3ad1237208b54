"""Episodes side by side; environments that hang, crash, change or end at once."""

import re

import gymnasium
import numpy as np
import pytest

import headway
import runs
from headway import task
from headway.errors import BadEnvironmentError
from headway.sim_params import SimParamSets
from headway.task import EnvSpec, register
from headway.training.collect import Batches, Choice, Episode
from headway.training.environments import Environments
from headway.training.run import RunDir
from headway.training.train import train_run
from headway.worlds.classic import PendulumTask

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
    own = {"name": "drift", "env_id": "own/Drift-v0", "make_task": PendulumTask}
    register(EnvSpec(**own, sim_params=sets, episode_length=6))
    yield make
    del gymnasium.registry["own/Drift-v0"], task._registered["drift"]


def config(**settings):
    own = {"collection.episode_length": 6, "collection.check": False}
    return runs.tiny_config("drift", **{**own, **settings})


@pytest.fixture(scope="module")
def sound(tmp_path_factory):
    """A run without any misbehaviour, trained when it is first asked for."""
    path = tmp_path_factory.mktemp("sound") / "run"

    def result():
        if not path.exists():
            train_run(config(), path)
        return runs.result(path)

    return result


def test_a_run_with_processes_equals_one_without(reference, tmp_path):
    run = train_run(runs.tiny_config(**PROCESSES), tmp_path / "run")
    assert run.config().collection.env_processes
    assert runs.result(run.path) == runs.result(reference)


INVALID = [
    ("hang_in_c", {**PROCESSES, "collection.step_timeout_s": 1.0}, "did not answer to step"),
    ("give_up", {}, "the robot fell apart"),
    ("lose_a_number", {}, "returned a non-finite obs"),
    ("pay_too_much", {}, "returned a non-finite reward"),
    ("leave_float32", {}, "returned a non-finite obs"),
]


@pytest.mark.parametrize(("how", "settings", "says"), INVALID, ids=[how for how, *_ in INVALID])
def test_an_invalid_episode_is_dropped_or_stops_the_run_and_loses_nothing(
    how, settings, says, drift, sound, tmp_path
):
    wanted = sound()
    drift(how, at=3, mark=str(tmp_path / "once"))
    heard = runs.Listening()
    run = train_run(config(**settings), tmp_path / "dropped", heard)
    (said,) = heard.said
    assert re.search(rf"{says}.*; the episode is dropped\.$", said)
    assert "at step 3 under {'drift': " in said
    whole = config().collection.num_episodes
    assert [row["collection"]["episodes"] for row in run.metrics()] == [whole - 1, whole, whole]

    (tmp_path / "once").unlink()
    strict = config(**settings, **{"collection.max_bad_episodes": 0})
    with pytest.raises(BadEnvironmentError, match=rf"1 episodes broke, allowed: 0 .*{says}"):
        train_run(strict, tmp_path / "run")
    drift()
    train_run(config(), tmp_path / "run")  # in one process, now that it is mended
    assert runs.result(tmp_path / "run") == wanted


def test_episodes_that_only_fill_a_batch_do_not_count(drift, tmp_path):
    own = {"collection.num_iterations": 1, "collection.num_episodes": 4}  # groups share a batch
    run = train_run(config(**own), tmp_path / "run")
    drift("give_up", drift=FAR)
    with pytest.raises(BadEnvironmentError, match="2 episodes broke, allowed: 0"):
        headway.evaluate(run.path, groups=["far"])


def test_tests_that_break_stop_the_run_until_they_may_be_left_out(drift, sound, tmp_path):
    wanted = sound()
    drift("give_up", drift=FAR)
    for allowed, says in ((0, r"2 episodes broke, allowed: 0"), (99, "and not all")):
        settings = config(**{"evaluation.max_bad_episodes": allowed})
        with pytest.raises(BadEnvironmentError, match=says):
            train_run(settings, tmp_path / "run")
    drift()
    train_run(config(), tmp_path / "run")  # what broke was not kept
    assert runs.result(tmp_path / "run") == wanted

    drift("give_up", drift=FAR, mark=str(tmp_path / "once"))
    run = train_run(config(**{"evaluation.max_bad_episodes": 1}), tmp_path / "left out")
    whole, left = (
        [(row.iteration, row.group, row.episode) for row in one.evaluation()]
        for one in (RunDir(tmp_path / "run"), run)
    )
    # The first one of the group broke; the others keep their numbers.
    assert [row for row in whole if row != (0, "far", 0)] == left
    (tmp_path / "once").unlink()
    settings = {**PROCESSES, "evaluation.max_bad_episodes": 1}
    again = headway.evaluate(run.path, groups=["far"], settings=settings)
    assert len(again) == config().evaluation.num_episodes - 1


def test_plans_that_find_nothing_finite_are_said_once(drift):
    said, episodes = [], [Episode({"drift": 0.5}, 0)]
    failing = Choice(np.zeros((2, 1), np.float32), np.full(2, 2), np.zeros(2, int))
    environments = Environments.make(config())
    batches = Batches(environments, config(), "collection", lambda steps: None, said.append)
    for name in ("first", "second"):
        batches.run(name, episodes, lambda: lambda obs: failing)
    assert [text.split(";")[0] for text in said] == [
        "collection: 12 of 12 planner iterations found no finite return"
    ]


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
def test_what_cannot_be_trusted_stops_the_run_with_the_reason(
    where, how, says, drift, sound, tmp_path
):
    """In either place, with what was done before saved; mended, the same command goes on."""
    wanted = sound()
    at = 0 if how.startswith("change") else 3
    drift(how, at=at, **({"drift": FAR} if where == "tests" else {}))
    with pytest.raises(BadEnvironmentError, match=says) as caught:
        train_run(config(), tmp_path / "run")
    assert "\n" not in str(caught.value)
    assert (tmp_path / "run/partial/fit.safetensors").exists() == (where == "tests")
    drift()
    train_run(config(), tmp_path / "run")
    assert runs.result(tmp_path / "run") == wanted


@pytest.mark.parametrize(
    ("how", "at", "named", "lengths"),
    [
        ("end", 1, {}, {1}),
        ("cut", 1, {}, {1}),
        ("count", 1, {}, {6}),
        ("end", 3, {"drift": 1.0}, {3, 6}),
    ],
)
def test_episodes_that_end_early_and_other_kinds_of_numbers_are_learned_from(
    how, at, named, lengths, drift, tmp_path
):
    """Whole numbers are numbers; and one transition is an episode, to learn from and to test."""
    drift(how, at=at, **named)
    run = train_run(config(), tmp_path / "run")
    data = run.load_data()
    assert {len(t) for t in data} == lengths
    assert {row.length for row in run.evaluation()} == lengths
    assert all(t.terminated == (how == "end" and len(t) == at) for t in data)
    assert run.metrics()[-1]["fitting"]["transitions"] == sum(map(len, data))
    assert all(np.isfinite(row["fitting"]["loss"]) for row in run.metrics())
