"""Environments that misbehave: a run goes on without the episode, or stops in one line."""

import killing
import numpy as np
import pytest
from killing import Listening

from headway.errors import BadEnvironmentError
from headway.experiment import training


def misbehave(monkeypatch, change, *, at):
    """Change what the n-th step of all environments returns."""
    make = training.Arena.make
    steps = []

    def made(config):
        arena = make(config)
        plain = arena.vector.step

        def step(actions):
            steps.append(1)
            found = plain(actions)
            return change(*found) if len(steps) in at else found

        monkeypatch.setattr(arena.vector, "step", step)
        return arena

    monkeypatch.setattr(training.Arena, "make", made)


def bad_obs(rows):
    def change(obs, *rest):
        obs = np.array(obs)
        obs[rows, 1] = np.nan
        return obs, *rest

    return change


def bad_reward(obs, reward, *rest):
    return obs, np.where(np.arange(len(reward)) == 1, np.inf, reward), *rest


@pytest.mark.parametrize("change", [bad_obs([1]), bad_reward], ids=["obs", "reward"])
def test_an_episode_that_breaks_is_dropped_and_said(change, tmp_path, monkeypatch):
    misbehave(monkeypatch, change, at=(3,))
    heard = Listening()
    run = training.train_run(killing.tiny_config(), tmp_path / "run", heard)
    (said,) = heard.said
    assert "at step 3 under {'length'" in said
    assert said.endswith("the episode is dropped.")
    whole = killing.tiny_config().collection.num_episodes
    assert [len(run.iteration_data(i)) for i in range(3)] == [whole - 1, whole, whole]
    assert len(run.metrics()) == 3


@pytest.mark.parametrize(("rows", "settings"), [([0, 1], {}), ([0], {"max_bad_episodes": 0})])
def test_too_many_broken_episodes_stop_the_run(rows, settings, tmp_path, monkeypatch):
    misbehave(monkeypatch, bad_obs(rows), at=(3,))
    config = killing.tiny_config(**{f"collection.{name}": v for name, v in settings.items()})
    with pytest.raises(BadEnvironmentError, match=r"episodes broke, allowed: \d \(.*the first"):
        training.train_run(config, tmp_path / "run")


def raising(*found):
    raise ZeroDivisionError("a simulator\nfailed")


def wrong_shape(obs, *rest):
    return obs[:, :2], *rest


def wrong_type(obs, *rest):
    return obs.astype("U"), *rest


@pytest.mark.parametrize(
    ("change", "says"),
    [
        (raising, "pendulum raised ZeroDivisionError at step 3: a simulator failed; correct"),
        (wrong_shape, "pendulum returned obs of shape .* at step 3, allowed: numbers of shape"),
        (wrong_type, "pendulum returned obs .* type <U32 at step 3, allowed: numbers"),
    ],
)
def test_what_cannot_be_gone_on_with_stops_in_one_line_and_loses_nothing(
    change, says, reference, tmp_path, monkeypatch
):
    with monkeypatch.context() as patch:
        misbehave(patch, change, at=(9,))
        says = says.replace("step 3", r"step \d")
        with pytest.raises(BadEnvironmentError, match=says) as caught:
            training.train_run(killing.tiny_config(), tmp_path / "run")
    assert "\n" not in str(caught.value)
    training.train_run(killing.tiny_config(), tmp_path / "run")
    assert killing.result(tmp_path / "run") == killing.result(reference)
