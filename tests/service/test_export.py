"""A controller as one file: equal to the library, without the library."""

import hashlib
import json
import subprocess
import sys
import zipfile
from pathlib import Path

import jax
import numpy as np
import pytest

import headway
import headway.envs
import toys
from headway.errors import ConfigError, PlanningError, RunError
from headway.planning.agent import Agent
from headway.planning.controller import Controller
from headway.service.export import OUTCOMES, Robot
from headway.spaces import Spaces
from headway.training.run import RunDir
from test_readme import python_blocks

ALONE = """
import sys

class Hidden:
    def find_spec(self, name, path=None, target=None):
        if name.partition(".")[0] in ("headway", "equinox", "optax", "gymnasium"):
            raise ModuleNotFoundError(name)

sys.meta_path.insert(0, Hidden())
import numpy as np

class Machine:
    def __init__(self):
        self.seen, self.sent = iter(np.load("seen.npy")), []

    def read(self):
        return next(self.seen)

    def send(self, action):
        self.sent.append(action)

    def stop(self):
        np.save("sent.npy", self.sent)

machine = Machine()
"""


@pytest.fixture(scope="module")
def file(reference, tmp_path_factory) -> Path:
    return headway.export(reference, tmp_path_factory.mktemp("export") / "controller.headway")


def test_the_example_acts_as_the_library_in_a_process_without_it(file, reference):
    """On 100 observations of an episode, of which some are broken.

    Bit for bit, were it not that programs are hardly optimised here (conftest.py).
    """
    controller, env = headway.load(reference), headway.envs.make("pendulum")
    obs, _ = env.reset(seed=1, options={"sim_params": {"length": 1.25}})
    seen, wanted = [], []
    while len(seen) < 100:
        seen.append(obs if len(seen) % 10 not in (3, 7, 8) else np.full(3, np.nan))
        wanted.append(controller.act(seen[-1]))
        obs = env.step(wanted[-1])[0]
    seen += 3 * [np.full(3, np.nan)]  # the plan of three steps ends
    np.save(file.with_name("seen.npy"), np.stack(seen))
    (example,) = [code for code in python_blocks("docs/controller.md") if "start.bin" in code]
    assert len(example.splitlines()) <= 20
    done = subprocess.run(
        [sys.executable, "-c", ALONE + example],
        cwd=file.parent,
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    sent = np.load(file.with_name("sent.npy"))
    assert len(sent) == 102  # two more of the plan, and then it stopped
    np.testing.assert_allclose(sent[:100], np.stack(wanted), atol=1e-5)


def test_the_file_describes_itself_and_brings_what_jax_reads_it_with(file, reference):
    with zipfile.ZipFile(file) as archive:
        about = json.loads(archive.read("description.json"))
        for name, digest in about["sha256"].items():
            assert hashlib.sha256(archive.read(name)).hexdigest() == digest
        exported = jax.export.deserialize(bytearray(archive.read("step.bin")))
    assert exported.platforms == ("cpu", "cuda")
    last = RunDir(reference).metrics()[2]["timesteps"]
    assert about["run"] == {
        "env": "pendulum", "method": "tmcl", "preset": "smoke", "seed": 0,
        "iteration": 2, "timesteps": last,
    }  # fmt: skip
    assert len(about["state"]) == len(jax.tree.leaves(exported.in_avals)) - 1
    assert (about["action_low"], about["action_high"]) == ([-2.0], [2.0])
    assert about["obs_names"][2] == "angular velocity (rad/s)"
    code = "import sys; sys.path.append(sys.argv[1]); import flatbuffers as f; print(f.__file__)"
    alone = [sys.executable, "-I", "-S", "-c", code, str(file)]
    assert subprocess.check_output(alone, text=True).startswith(str(file))


SPACES = {
    "box": Spaces(2, "box", (-2.0, 0.0), (2.0, 40.0), (2,), "float64"),
    "integers": Spaces(2, "integers", (0.0, -3.0), (5.0, 3.0), (2,), "int64"),
    "categories": Spaces(2, "categories", (0.0,), (1.0,), (), "int64"),
}


@pytest.mark.parametrize("kind", SPACES)
def test_actions_and_outcomes_are_those_of_a_controller(kind):
    """Also where the action was another than the one asked for, or nobody knows which."""

    class AnyTask(headway.Task):
        def reward(self, obs, action, next_obs):
            return -(next_obs**2).sum(-1) + action[..., 0]

    agent = toys.make_agent(task=AnyTask(told_spaces=SPACES[kind]))
    controller, robot = Controller(agent), Robot(agent)
    step, state = jax.jit(robot.step), robot.start(0, 0)
    for seen in ([0.3, 0.4], [0.1, 0.2], [np.nan, 0.0], [0.2, 0.1], *4 * [[np.inf, 0.0]]):
        obs = np.float32(seen)
        state, action, heads, outcome = step(state, obs)
        try:
            wanted = controller.act(obs)
        except PlanningError:
            assert OUTCOMES[int(outcome)] == "none left"
            assert kind != "box" or np.isnan(action).all()
            break
        assert OUTCOMES[int(outcome)] == controller.status.outcome
        np.testing.assert_allclose(action, wanted, rtol=1e-6)
        assert np.shape(action) == np.shape(wanted)
        if controller.heads is not None:
            np.testing.assert_array_equal(heads, controller.heads)
    else:
        pytest.fail("the plan never ended")
    huge = np.float32([3e38, 0.0])  # whose returns are infinite, so that there is no plan
    state, *_, outcome = step(state, huge)
    with pytest.raises(PlanningError, match="found a finite return"):
        controller.act(huge)
    assert OUTCOMES[int(outcome)] == "none left"
    assert not robot._unpack(state)[0].acted.any()
    for number in (1.0, np.nan):
        applied = np.full(SPACES[kind].action_shape, number, np.float32)
        controller._correct(applied)
        state = jax.jit(robot.applied)(state, applied)
        now = robot._unpack(state)[0]
        np.testing.assert_array_equal(now.acted, controller._state.acted)
        np.testing.assert_allclose(now.action, controller._state.action, atol=1e-6)


def test_what_cannot_be_exported_is_refused(tmp_path, reference, monkeypatch):
    with pytest.raises(ConfigError, match="acts at random"):
        Robot(Agent(None, toys.POINT, toys.TINY))
    with pytest.raises(RunError, match="no regular file"):
        headway.export(reference, tmp_path)
    with pytest.raises(RunError, match="is not a directory"):
        headway.export(tmp_path / "none", tmp_path / "a.headway")
    monkeypatch.setattr("headway.errors.find_spec", lambda name: None)
    with pytest.raises(ConfigError, match=r"^flatbuffers not installed; .*'headway\[export\]'\.$"):
        headway.export(reference, tmp_path / "a.headway")
    assert not [*tmp_path.iterdir()]
