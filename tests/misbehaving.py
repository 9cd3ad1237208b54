"""An environment that misbehaves when told to. It needs little, so its processes begin quickly."""

import ctypes
import os
import signal
import subprocess
import sys
from pathlib import Path

import gymnasium
import numpy as np

from headway.errors import BrokenEpisodeError


class Drift(gymnasium.Env):
    """Numbers that drift by the hidden parameter.

    Args:
        how: The name of a method that is called in the step before `at`; 0 is the reset.
        at: Which step of an episode.
        mark: A file; the environment misbehaves only where it makes it.
        drift: Only environments under this physics misbehave, if given.
    """

    observation_space = gymnasium.spaces.Box(-np.inf, np.inf, (3,), np.float64)
    action_space = gymnasium.spaces.Box(-2, 2, (1,), np.float32)

    def __init__(self, how="", at=3, mark="", drift=None):
        self.how, self.at, self.mark, self.only = how, at, mark, drift
        self.elapsed = 0

    def set_sim_params(self, values):
        self.drift = values["drift"]

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.drift = (options or {}).get("sim_params", {}).get("drift", 0.5)
        self.position = self.np_random.normal(size=3)
        self.elapsed = 0
        self.misbehave()
        return self.position.copy(), {"sim_params": {"drift": self.drift}}

    def step(self, action):
        self.elapsed += 1
        self.position += self.drift * self.np_random.normal(size=3)
        result = {
            "obs": self.position.copy(),
            "reward": float(action[0]),
            "terminated": self.elapsed >= 12,
            "truncated": False,
            "info": {},
        }
        return tuple((result | (self.misbehave() or {})).values())

    def render(self):
        if self.how == "render":
            self.leave()

    def misbehave(self):
        if not self.how or self.elapsed != self.at or self.only not in (None, self.drift):
            return None
        if self.mark:
            try:
                Path(self.mark).touch(exist_ok=False)
            except FileExistsError:
                return None
        return getattr(self, self.how)()

    def hang_in_c(self):
        """No Python code can run meanwhile, as in a simulator that waits for ever."""
        ctypes.PyDLL(None).sleep(1000)

    def hang_with_a_child(self):
        subprocess.Popen([sys.executable, "-c", "import time; time.sleep(1000)"])
        self.hang_in_c()

    def crash(self):
        os.kill(os.getpid(), signal.SIGSEGV)

    def leave(self):
        os._exit(3)

    def fail(self):
        raise ZeroDivisionError("a simulator\nfailed")

    def fail_oddly(self):
        class OddError(Exception):
            pass

        raise OddError("odd")

    def give_up(self):
        raise BrokenEpisodeError("the robot fell apart")

    def end(self):
        return {"terminated": True}

    def cut(self):
        return {"truncated": True}

    def lose_a_number(self):
        return {"obs": np.array([0.0, np.nan, 0.0])}

    def pay_too_much(self):
        return {"reward": np.inf}

    def leave_float32(self):
        return {"obs": np.array([0.0, 1e39, 0.0])}

    def count(self):
        return {"obs": np.array([1, 2, 3]), "reward": 1}

    def shrink(self):
        return {"obs": self.position[:2]}

    def speak(self):
        return {"obs": np.array(["a", "b", "c"])}

    def lose_the_reward(self):
        return {"reward": None}

    def change_spaces(self):
        self.observation_space = gymnasium.spaces.Box(-1, 1, (2,), np.float64)

    def change_actions(self):
        self.action_space = gymnasium.spaces.Box(-1, 1, (2,), np.float32)


class Alone(Drift):
    """Only one can exist: it holds the file `mark`."""

    def __init__(self, mark):
        super().__init__(mark=mark)
        Path(mark).touch(exist_ok=False)

    def close(self):
        Path(self.mark).unlink()


class Drawn(Drift):
    """It can be drawn."""

    metadata = {"render_modes": ["rgb_array"], "render_fps": 10}  # noqa: RUF012

    def __init__(self, how="", at=3, render_mode=None):
        super().__init__(how, at)
        self.render_mode = render_mode

    def render(self):
        return np.zeros((8, 8, 3), np.uint8)


def wrapped(**options):
    """Pays 7 whatever happens."""
    return gymnasium.wrappers.TransformReward(Drawn(**options), lambda reward: 0 * reward + 7.0)
