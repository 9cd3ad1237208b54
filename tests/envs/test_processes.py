"""Environments in processes of their own: equal results, and what hangs or crashes is given up."""

import functools
import os
import signal
import subprocess
import sys
import threading
import time

import numpy as np
import pytest
from env_helpers import assert_same

import misbehaving
from headway.envs import ProcessVectorEnv, SequentialVectorEnv
from headway.errors import BadEnvironmentError, ConfigError

TIMEOUT_S = 60.0
"""For steps that answer; the machine may be busy."""


def some(how="", **named):
    """The first of two environments misbehaves."""
    return [functools.partial(misbehaving.Drift, how, **named), misbehaving.Drift]


@pytest.fixture
def made():
    """Makes processes, and ends them."""
    vectors = []

    def make(how="", *, timeout_s=TIMEOUT_S, **named):
        vectors.append(ProcessVectorEnv(some(how, **named), step_timeout_s=timeout_s))
        return vectors[-1]

    yield make
    for vector in vectors:
        vector.close()


def gone(pid):
    """Wait until a process and its group are gone; the machine may be busy."""
    until = time.monotonic() + 60
    while time.monotonic() < until:
        try:
            os.killpg(pid, 0)
        except ProcessLookupError:
            return True
        time.sleep(0.05)
    return False


ONES = np.ones((2, 1), np.float32)


def pids(vector):
    return [env.processes[0].pid for env in vector.envs]


def test_results_equal_those_of_one_process(made):
    vectors, drifts = (SequentialVectorEnv(some()), made()), []
    options = {"schedule": [{4: {"drift": 3.0}}, {}]}
    assert_same(*(vector.reset(seed=3, options=options) for vector in vectors))
    for step in range(14):  # they end after 12
        one, other = (vector.step(ONES * step / 10) for vector in vectors)
        assert_same(one, other)
        drifts.append(one[-1]["sim_params"]["drift"].tolist())
    assert [3.0, 0.5] in drifts
    options = {"reset_mask": np.array([True, False])}
    assert_same(*(vector.reset(options=options) for vector in vectors))


@pytest.mark.parametrize(
    ("how", "reason"),
    [
        ("hang_with_a_child", "did not answer to step within 2 s"),
        ("crash", "had its process killed by SIGSEGV during step"),
        ("leave", "had its process over (3) during step"),
        ("give_up", "the robot fell apart"),
    ],
)
def test_what_is_lost_costs_its_episode_only(how, reason, made, tmp_path):
    vector = made(how, timeout_s=2.0 if "hang" in how else TIMEOUT_S, mark=str(tmp_path / "once"))
    before, goes_on = pids(vector), how == "give_up"
    vector.reset(seed=0)
    for _ in range(2):
        assert "broken" not in vector.step(ONES)[-1]
    obs, reward, terminated, truncated, info = vector.step(ONES)
    assert info["broken"] == {0: reason}
    assert np.isnan(obs[0]).all()
    assert np.isnan(reward[0])
    assert (terminated.tolist(), truncated.tolist()) == ([False, False], [True, False])
    assert [new == old for new, old in zip(pids(vector), before, strict=True)] == [goes_on, True]
    assert goes_on or gone(before[0])
    _, reward, _, truncated, _ = vector.step(ONES)  # the other one goes on
    assert (reward.tolist(), truncated.tolist()) == ([0.0, 1.0], [True, False])
    again, info = vector.reset(seed=0)  # and both begin another episode
    assert "broken" not in info
    np.testing.assert_array_equal(again, SequentialVectorEnv(some()).reset(seed=0)[0])
    last = pids(vector)
    vector.close()
    assert all(map(gone, last))


def test_what_is_lost_while_it_draws_keeps_its_reason(made):
    vector = made("render", at=-1)
    vector.reset(seed=0)
    assert len(vector.render()) == 1  # of the other one
    for _ in range(2):
        obs, _, _, truncated, info = vector.step(ONES)
        assert info["broken"] == {0: "had its process over (3) during render"}
        assert truncated.tolist() == np.isnan(obs).all(1).tolist() == [True, False]
    assert "broken" not in vector.reset()[1]


def test_a_reset_that_hangs_is_tried_again_in_the_next_episode(made, tmp_path):
    vector = made("hang_in_c", timeout_s=2.0, at=0, mark=str(tmp_path / "once"))
    obs, info = vector.reset(seed=0)
    assert info["broken"] == {0: "did not answer to reset within 2 s"}
    assert np.isnan(obs).any(1).tolist() == [True, False]
    assert "broken" not in vector.reset(seed=0)[1]


@pytest.mark.parametrize("timeout", [{}, {"step_timeout_s": TIMEOUT_S}])
def test_where_only_one_can_exist_it_is_closed_and_the_setting_is_named(timeout, tmp_path):
    make = functools.partial(misbehaving.Alone, str(tmp_path / "port"))
    kind = ProcessVectorEnv if timeout else SequentialVectorEnv
    with pytest.raises(BadEnvironmentError, match=r"2 of 2 .*set collection.num_episodes to 1"):
        kind([make] * 2, **timeout)
    assert not (tmp_path / "port").exists()
    kind([make], **timeout).close()
    assert not (tmp_path / "port").exists()


@pytest.mark.parametrize(
    ("how", "says"),
    [("fail", "raised ZeroDivisionError: a simulator failed"), ("fail_oddly", "OddError: odd")],
)
def test_what_an_environment_raises_arrives_and_its_process_goes_on(how, says, made, tmp_path):
    vector = made(how, mark=str(tmp_path / "once"))
    before = pids(vector)
    assert {os.getpgid(pid) for pid in before} == {*before}  # Ctrl-C reaches the parent only
    vector.reset(seed=0)
    for _ in range(2):
        vector.step(ONES)
    with pytest.raises(BadEnvironmentError, match=says):
        vector.step(ONES)
    assert np.isfinite(vector.reset(seed=0)[0]).all()  # nobody's answer is left over
    assert pids(vector) == before
    with pytest.raises(ConfigError, match="step_timeout_s"):
        made(timeout_s=0.0)
    with pytest.raises(ConfigError, match=r"cannot be sent to a process .*cannot pickle"):
        made(threading.Lock())


PARENT = """
import functools, os, signal, sys
import misbehaving
import numpy as np
from headway.envs import ProcessVectorEnv

if __name__ == "__main__":
    signal.signal(signal.SIGINT, signal.default_int_handler)  # a job in the background ignores it
    one = functools.partial(misbehaving.Drift, sys.argv[1])
    vector = ProcessVectorEnv([one, misbehaving.Drift], step_timeout_s=500.0)
    print(*(env.processes[0].pid for env in vector.envs), flush=True)
    vector.reset(seed=0)
    for step in range(3):
        vector.step(np.ones((2, 1), np.float32))
"""


@pytest.mark.parametrize(("how", "kill"), [("fail", None), ("hang_in_c", signal.SIGINT)])
def test_no_process_outlives_its_parent(how, kill, tmp_path):
    """One environment raises; another hangs in C until Ctrl-C."""
    script = tmp_path / "parent.py"
    script.write_text(PARENT)
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(sys.path)}
    parent = subprocess.Popen(
        [sys.executable, str(script), how], stdout=subprocess.PIPE, env=environment, text=True
    )
    assert parent.stdout is not None
    try:
        workers = list(map(int, parent.stdout.readline().split()))
        if kill:
            time.sleep(2.0)
            parent.send_signal(kill)
        parent.wait(timeout=60)
        assert len(workers) == 2
        assert all(map(gone, workers))
    finally:
        parent.kill()
