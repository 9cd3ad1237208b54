"""Environments in processes of their own: equal results, and what hangs or crashes is given up."""

import contextlib
import functools
import os
import signal
import subprocess
import sys
import time

import numpy as np
import pytest
from gymnasium.vector import AutoresetMode

import misbehaving
from headway.envs import ProcessVectorEnv, SequentialVectorEnv
from headway.errors import BadEnvironmentError, BrokenEpisodeError, ConfigError

TIMEOUT_S = 20.0
"""For steps that answer; the machine may be busy."""


def some(how="", number=2, **named):
    """The first of some environments misbehaves."""
    first = functools.partial(misbehaving.Drift, how, **named)
    return [first, *[misbehaving.Drift] * (number - 1)]


def made(how="", *, timeout_s=TIMEOUT_S, mode=AutoresetMode.DISABLED, number=2, **named):
    env_fns = some(how, number, **named)
    return ProcessVectorEnv(env_fns, step_timeout_s=timeout_s, autoreset_mode=mode)


def wait_for(found):
    """Wait until there is something; the machine may be busy."""
    until = time.monotonic() + 60
    while time.monotonic() < until:
        if result := found():
            return result
        time.sleep(0.05)
    raise AssertionError("nothing came")


def gone(pid):
    """Whether a process and its group are gone, or are soon."""

    def is_gone():
        try:
            os.killpg(pid, 0)
        except ProcessLookupError:
            return True
        return False

    return wait_for(is_gone)


def ones(vector):
    return np.ones((vector.num_envs, 1), np.float32)


@pytest.mark.parametrize("mode", [AutoresetMode.DISABLED, AutoresetMode.NEXT_STEP])
def test_results_equal_those_of_one_process(mode):
    kinds = {"autoreset_mode": mode, "episode_length": 9}
    schedule = [{4: {"drift": 3.0}}, {}]
    records = []
    for vector in (
        SequentialVectorEnv(some(), **kinds),
        ProcessVectorEnv(some(), step_timeout_s=TIMEOUT_S, **kinds),
    ):
        rows = [vector.reset(seed=3, options={"schedule": schedule})]
        rows += [vector.step(ones(vector) * step / 10) for step in range(14)]
        records.append(rows)
        vector.close()
    for one, other in zip(*records, strict=True):
        for x, y in zip(one[:-1], other[:-1], strict=True):
            assert x.dtype == y.dtype
            np.testing.assert_array_equal(x, y)
        assert one[-1].keys() == other[-1].keys()
        np.testing.assert_array_equal(
            one[-1]["sim_params"]["drift"], other[-1]["sim_params"]["drift"]
        )
    drifts = [row[-1]["sim_params"]["drift"].tolist() for row in records[0]]
    assert [0.5, 0.5] in drifts
    assert [3.0, 0.5] in drifts


@pytest.mark.parametrize(
    ("how", "reason"),
    [
        ("hang_in_c", "did not answer to step within 1 s"),
        ("crash", "had its process killed by SIGSEGV during step"),
        ("leave", "ended its process with exit code 3 during step"),
    ],
)
def test_what_is_lost_costs_its_episode_only(how, reason, tmp_path):
    vector = made(how, timeout_s=1.0, mark=str(tmp_path / "once"))
    before = vector.pids
    vector.reset(seed=0)
    for _ in range(2):
        assert "broken" not in vector.step(ones(vector))[-1]
    obs, reward, terminated, truncated, info = vector.step(ones(vector))
    assert info["broken"] == {0: reason}
    assert np.isnan(obs[0]).all()
    assert np.isnan(reward[0])
    assert (terminated.tolist(), truncated.tolist()) == ([False, False], [True, False])
    assert vector.pids[0] != before[0]
    assert vector.pids[1] == before[1]
    assert gone(before[0])
    _, reward, _, truncated, _ = vector.step(ones(vector))  # the other one goes on
    assert (reward.tolist(), truncated.tolist()) == ([0.0, 1.0], [True, False])
    again, info = vector.reset(seed=0)  # and both begin another episode
    assert "broken" not in info
    first, _ = SequentialVectorEnv(some()).reset(seed=0)
    np.testing.assert_array_equal(again, first)
    for _ in range(4):
        assert np.isfinite(vector.step(ones(vector))[0]).all()
    pids = vector.pids
    vector.close()
    assert all(map(gone, pids))


def test_a_reset_that_hangs_is_tried_again_in_the_next_episode(tmp_path):
    mode = AutoresetMode.NEXT_STEP
    vector = made("hang", timeout_s=1.0, mode=mode, at=0, mark=str(tmp_path / "once"))
    obs, info = vector.reset(seed=0)
    assert info["broken"] == {0: "did not answer to reset within 1 s"}
    assert np.isnan(obs).any(1).tolist() == [True, False]
    obs, reward, _, truncated, info = vector.step(ones(vector))
    assert "broken" not in info
    assert np.isfinite(obs).all()
    assert (reward.tolist(), truncated.tolist()) == ([0.0, 1.0], [False, False])
    vector.close()


def test_a_next_episode_that_cannot_begin_is_cut_and_tried_again():
    class Falls(misbehaving.Drift):
        def reset(self, **given):
            if self.elapsed:
                self.elapsed = 0
                raise BrokenEpisodeError("it fell over")
            return super().reset(**given)

    vector = SequentialVectorEnv([Falls, misbehaving.Drift], episode_length=2)
    vector.reset(seed=0)
    for _ in range(2):
        vector.step(ones(vector))
    obs, reward, _, truncated, info = vector.step(ones(vector))
    assert info["broken"] == {0: "it fell over"}
    assert np.isnan(obs).any(1).tolist() == [True, False]
    assert np.isnan(reward).tolist() == truncated.tolist() == [True, False]
    obs, reward, _, truncated, info = vector.step(ones(vector))  # begins at last
    assert "broken" not in info
    assert np.isfinite(obs).all()
    assert (reward.tolist(), truncated.tolist()) == ([0.0, 1.0], [False, False])
    vector.close()


def test_an_environment_can_give_an_episode_up_itself():
    for vector in (
        made("give_up"),
        SequentialVectorEnv(some("give_up"), autoreset_mode="Disabled"),
    ):
        vector.reset(seed=0)
        for _ in range(3):
            info = vector.step(ones(vector))[-1]
        assert info["broken"] == {0: "the robot fell apart"}
        pids = getattr(vector, "pids", None)
        assert "broken" not in vector.reset(seed=0)[1]
        assert getattr(vector, "pids", None) == pids  # its process is as good as before
        vector.close()


@pytest.mark.parametrize(
    ("how", "error", "text"),
    [("fail", ZeroDivisionError, "a simulator"), ("fail_oddly", RuntimeError, r"OddError: odd")],
)
def test_what_an_environment_raises_arrives_with_its_traceback(how, error, text, tmp_path):
    vector = made(how, mark=str(tmp_path / "once"))
    vector.reset(seed=0)
    for _ in range(2):
        vector.step(ones(vector))
    with pytest.raises(error, match=text) as caught:
        vector.step(ones(vector))
    assert f"in {how}" in caught.value.__notes__[0]
    assert np.isfinite(vector.reset(seed=0)[0]).all()  # nobody's answer is left over
    vector.close()


def test_an_interrupted_answer_is_not_taken_for_the_next(tmp_path):
    vector = made()
    vector.reset(seed=0)
    vector._workers[0].send("step", (np.ones(1, np.float32),))  # nobody waits for it
    again = vector.reset(seed=5)[0]
    np.testing.assert_array_equal(again, SequentialVectorEnv(some()).reset(seed=5)[0])
    vector.close()


def test_only_the_parent_answers_a_request_to_stop():
    """A scheduler sends SIGTERM to every process of a job, and the parent saves first."""
    vector = made()
    vector.reset(seed=0)
    for number in (signal.SIGTERM, signal.SIGINT):
        os.killpg(vector.pids[0], number)
        assert "broken" not in vector.step(ones(vector))[-1]
    os.killpg(vector.pids[0], signal.SIGKILL)
    info = vector.step(ones(vector))[-1]
    assert info["broken"] == {0: "had its process killed by SIGKILL during step"}
    vector.close()


def test_a_process_that_dies_in_the_middle_of_its_answer_costs_its_episode_only(monkeypatch):
    vector = made("swell", at=1)
    vector.reset(seed=0)
    worker = vector._workers[0]
    receive = worker.receive

    def killed_first(*given):
        wait_for(lambda: worker._connection.poll(0))  # it has begun to answer, and must wait
        os.killpg(worker.pid, signal.SIGKILL)
        return receive(*given)

    monkeypatch.setattr(worker, "receive", killed_first)
    info = vector.step(ones(vector))[-1]
    assert info["broken"] == {0: "had its process killed by SIGKILL during step"}
    vector.close()


@pytest.mark.parametrize("how", ["change_spaces", "change_actions"])
def test_spaces_must_stay_as_they_are(how):
    for vector in (made(how, at=0), SequentialVectorEnv(some(how, at=0))):
        with pytest.raises(BadEnvironmentError, match=r"space .*allowed: .* in every episode"):
            vector.reset(seed=0)
        vector.close()


def test_what_cannot_be_made_is_told_at_once():
    def broken():
        raise FileNotFoundError("no such robot")

    with pytest.raises(FileNotFoundError, match="no such robot"):
        ProcessVectorEnv([broken], step_timeout_s=1.0)
    with pytest.raises(BadEnvironmentError, match="exit code 3 during start; see to it"):
        ProcessVectorEnv([lambda: os._exit(3)], step_timeout_s=1.0)
    with pytest.raises(ConfigError, match="step_timeout_s"):
        made(timeout_s=0.0)


PARENT = """
import functools, os, signal
import misbehaving
import numpy as np
from headway.envs import ProcessVectorEnv

def act(how):
    signal.signal(signal.SIGINT, signal.default_int_handler)
    one = functools.partial(misbehaving.Drift, how)
    vector = ProcessVectorEnv([one, misbehaving.Drift], step_timeout_s=500.0)
    line = " ".join(map(str, (os.getpid(), *vector.pids)))
    os.write(1, f"{line}\\n".encode())  # whole, or the lines of four processes mix
    vector.reset(seed=0)
    for step in range(3):
        vector.step(np.ones((2, 1), np.float32))

for how in ("fail", "hang_with_a_child", "hang_with_a_child", "hang_with_a_child"):
    if os.fork() == 0:  # before anything was computed
        act(how)
        break
else:
    for _ in range(4):
        os.wait()
"""


def test_no_process_outlives_its_parent():
    """Environments hang in C, and have started processes of their own; or one raises."""
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(sys.path)}
    all_parents = subprocess.Popen(
        [sys.executable, "-c", PARENT],
        stdout=subprocess.PIPE,
        env=environment,
        text=True,
        process_group=0,
    )
    assert all_parents.stdout is not None
    parents = [list(map(int, all_parents.stdout.readline().split())) for _ in range(4)]
    hanging = {parent: workers[0] for parent, *workers in parents}
    try:
        for number in (signal.SIGINT, signal.SIGTERM, signal.SIGKILL):
            ready = wait_for(
                lambda: [p for p, group in hanging.items() if len(members(group)) == 3]
            )
            del hanging[ready[0]]
            os.kill(ready[0], number)
        all_parents.communicate(timeout=60)
        assert all(gone(pid) for _, *workers in parents for pid in workers)
    except BaseException:  # the test has failed; it shall outlive nothing either
        for group in (all_parents.pid, *[pid for _, *workers in parents for pid in workers]):
            with contextlib.suppress(ProcessLookupError):
                os.killpg(group, signal.SIGKILL)
        all_parents.wait()
        raise


def members(group):
    """The processes of a group: the guard, the environment, and what that has started."""
    found = subprocess.run(["ps", "-A", "-o", "pgid="], capture_output=True, text=True, check=True)
    return [word for word in found.stdout.split() if int(word) == group]
