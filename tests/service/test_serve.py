"""Robots at a WebSocket: sessions, deadlines, strangers, and what is wrong with a message."""

import contextlib
import itertools
import json
import os
import signal
import socket
import subprocess
import sys
import threading
import time
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
from websockets.exceptions import ConnectionClosed, InvalidStatus
from websockets.sync.client import connect

import headway
from headway.errors import ConfigError
from headway.service.serve import serve
from test_readme import python_blocks

TOKEN = {"Authorization": "Bearer secret"}
OBS = [1.0, 0.0, 0.0]
DEADLINE = 500.0  # milliseconds, of a machine that runs other tests too


@pytest.fixture(scope="module")
def server(reference):
    words = f"serve {reference} --port 0 --json --max-robots 2 --silence-s 5".split()
    command = [sys.executable, "-m", "headway", *words, "--deadline-ms", str(DEADLINE)]
    with subprocess.Popen(
        command,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        env={**os.environ, "HEADWAY_TOKEN": "secret"},
    ) as process:
        process.facts = json.loads(process.stdout.readline())
        yield process
        process.kill()


@pytest.fixture
def robot(server):
    with connect(server.facts["url"], additional_headers=TOKEN) as robot:
        yield robot


def ask(robot, message):
    robot.send(message if isinstance(message, (str, bytes)) else json.dumps(message))
    return json.loads(robot.recv(timeout=30))


@pytest.fixture(scope="module")
def library(reference):
    """The controller of the robot that comes first."""
    controller = headway.load(reference, seed=1, deadline_ms=1e6)
    controller.reset()  # as a session begins
    return controller


@contextlib.contextmanager
def joined(url):
    """A new session, where one that broke off has just been left."""
    for _ in range(100):
        with connect(url, additional_headers=TOKEN) as robot:
            answer = {"error": "closed"}
            with contextlib.suppress(ConnectionClosed):
                answer = ask(robot, {"reset": True})
            if "error" not in answer:
                yield robot
                return
        time.sleep(0.05)
    raise AssertionError("no session became free")


def test_a_session_acts_as_the_library(library, robot):
    for obs, *applied in [(OBS,), (OBS, [0.5]), (OBS, [None]), ([1.0, None, 0.0],)]:
        told = {"applied_action": np.array(applied[0], float)} if applied else {}
        wanted = library.act(np.array(obs, float), **told)
        got = ask(robot, dict(zip(("obs", "applied_action"), (obs, *applied), strict=False)))
        np.testing.assert_allclose(got["action"], wanted, atol=1e-5)
        assert got["heads"] == library.heads.tolist()
        assert got["outcome"] == library.status.outcome
    assert got["reason"].startswith("obs[1] is nan")
    assert ask(robot, {"reset": True}) == {"reset": True}


def test_the_client_of_the_page(server):
    (code,) = [block for block in python_blocks("docs/controller.md") if "websockets" in block]
    code = code.replace('"ws://127.0.0.1:8765"', "url, additional_headers=token")
    names = {"url": server.facts["url"], "token": TOKEN}
    exec(code.replace("[0.5, 0.0]", "[1.0, 0.0, 0.0]").replace("timeout=1", "timeout=30"), names)
    assert {"action", "outcome", "reason", "warnings", "iterations", "seconds"} < {*names["answer"]}


def test_a_thousand_observations_of_two_robots_are_answered_in_time(server):
    def drive(seed):
        rng, found = np.random.default_rng(seed), []
        with connect(server.facts["url"], additional_headers=TOKEN) as robot:
            for _ in range(500):
                found.append(ask(robot, {"obs": rng.normal(size=3).tolist()}))
        return found

    with ThreadPoolExecutor() as threads:
        answers = [*itertools.chain(*threads.map(drive, range(2)))]
    assert len(answers) == 1000
    late = [answer["seconds"] for answer in answers if 1000 * answer["seconds"] > DEADLINE]
    assert len(late) <= 5  # pauses of the system


@pytest.mark.parametrize(
    ("message", "error"),
    [
        ("", "cannot be read"),
        ("{", "cannot be read"),
        (b"\xff\xfe\x00", "cannot be read"),
        ("[" * 50_000, "cannot be read"),
        ("[]", "allowed: {"),
        ({"observation": OBS}, "allowed: {"),
        ({"obs": OBS, "reset": True}, "allowed: {"),
        ({"obs": None}, "obs "),
        ({"obs": "x"}, "obs is 'x'"),
        ({"obs": OBS[:2]}, r"obs has shape (2,), allowed: (3,)"),
        ({"obs": [OBS, {}]}, "obs is"),
        ('{"obs": [' + "9" * 4000 + ", 0, 0]}", "obs[0] is inf"),
        ({"obs": [None, 0, 0]}, "no earlier plan is left"),
        ({"obs": OBS, "applied_action": [99]}, "applied_action[0] is 99"),
    ],
)
def test_what_is_wrong_with_a_message_is_its_answer_and_harms_nothing(message, error, robot):
    answer = ask(robot, message)
    assert error in answer["error"]
    assert "\n" not in answer["error"]
    assert len(answer["error"]) < 500
    assert ask(robot, {"obs": OBS})["outcome"] in ("planned", "deadline")


def test_strangers_are_refused_and_robots_that_break_off_make_room(server, robot):
    url = server.facts["url"]
    for headers in ({}, {"Authorization": "Bearer wrong"}, {"Authorization": "Bearer sécret"}):
        with pytest.raises(InvalidStatus) as refused, connect(url, additional_headers=headers):
            pass
        assert refused.value.response.status_code == 401
        assert "token missing or wrong" in json.loads(refused.value.response.body)["error"]
    with pytest.raises(InvalidStatus, match="403"):  # somebody's browser
        connect(url, additional_headers=TOKEN, origin="http://example.com").__enter__()
    with connect(url, additional_headers=TOKEN) as other:
        with connect(url, additional_headers=TOKEN) as third:
            assert (
                "as many robots are connected as max_robots"
                in json.loads(third.recv(timeout=30))["error"]
            )
            with pytest.raises(ConnectionClosed, match="1013"):
                third.recv(timeout=30)
        with pytest.raises(ConnectionClosed, match="1009"):
            ask(other, {"obs": [1.0] * 50_000})
    for _ in range(5):  # break off in the middle of a plan
        with joined(url) as other:
            other.send(json.dumps({"obs": OBS}))
            other.socket.shutdown(socket.SHUT_RDWR)
        assert "action" in ask(robot, {"obs": OBS})
    with joined(url) as other:
        assert "action" in ask(other, {"obs": OBS})


def test_silence_and_the_end_close_a_session(server):
    url = server.facts["url"]
    with (
        connect(url, additional_headers=TOKEN) as silent,
        connect(url, additional_headers=TOKEN) as robot,
    ):
        asking = threading.Timer(3.0, robot.send, [json.dumps({"obs": OBS})])
        asking.start()
        with pytest.raises(ConnectionClosed, match="no message for 5 s"):
            silent.recv(timeout=30)
        assert "action" in json.loads(robot.recv(timeout=30))
        server.send_signal(signal.SIGTERM)
        with pytest.raises(ConnectionClosed, match="1001"):
            robot.recv(timeout=30)
    assert server.wait(timeout=30) == 0
    said = server.stderr.read()
    assert "Traceback" not in said
    assert "ended after 1 answers: the robot left" in said


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"host": "0.0.0.0"}, "can be reached from other machines, allowed: with a token"),
        ({"host": "example.com"}, "can be reached"),
        ({"port": 70_000}, "0 to 65535"),
        ({"max_robots": 0}, "max_robots is 0"),
        ({"silence_s": 0.0}, "silence_s 0"),
    ],
)
def test_what_cannot_be_served_is_said_at_once(settings, message, tmp_path):
    with pytest.raises(ConfigError, match=message):
        serve(tmp_path, **settings)
