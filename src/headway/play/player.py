"""A controller and its environment, step by step, while somebody changes the physics; no page."""

import queue
import time
from collections import deque
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float, Int

from headway.api import load
from headway.config import LARGEST, override
from headway.errors import BadEnvironmentError, HeadwayError, PlanningError
from headway.sim_params import Uniform
from headway.task import env_spec
from headway.training.environments import Environments, raising
from headway.training.run import RunDir

REMEMBERED = 200
"""Steps that are remembered, and shown."""
IDLE_S = 0.2
"""Longest sleep while nothing moves."""


class Moment(NamedTuple):
    """One step, and what the controller thought of it."""

    obs: Float[np.ndarray, " obs"]
    """What was observed after the step."""
    imagined: Float[np.ndarray, "horizon obs"] | None
    """What the plan of that step led to in the mean of the members, from this step on; None where
    there was no new plan."""
    reward: float
    heads: Int[np.ndarray, " member"] | None
    """The head that each member planned with; None where the model has none."""
    seconds: float
    """What the plan took."""
    changed: bool
    """Whether the physics changed before it."""


class Player:
    """A trained controller in one environment without an end, on a clock.

    `run` steps in the thread that calls it, in real time. Other threads `ask` for what is to
    change; it is done between two steps.

    Args:
        run_dir: The run directory.

    Raises:
        RunError: There is no trained run, or it is damaged.
        BadEnvironmentError: The environment cannot be made.
    """

    def __init__(self, run_dir: str | Path):
        self._run_dir = run_dir
        self.config = RunDir(run_dir).config()
        self.spec = env_spec(self.config.env)
        self.controller = load(run_dir)
        endless = override(self.config, {"collection.episode_length": LARGEST})
        try:
            self.environments = Environments.make(endless, single=True, film=True)
        except BadEnvironmentError:  # one that draws no frames
            self.environments = Environments.make(endless, single=True)
        self.env: Any = self.environments.vector
        self._sets = self.environments.sim_params
        self.rate = float(self.env.metadata["render_fps"] or 20)
        """Steps per second of the environment's own clock."""
        self.speed, self.paused, self.stopped = 1.0, False, False
        self.message = ""
        """What last went wrong, in one line."""
        self.moments: deque[Moment] = deque(maxlen=REMEMBERED)
        self.obs: Float[np.ndarray, " obs"]
        """The newest observation."""
        self.asked: queue.Queue[Callable[[], Any]] = queue.Queue()
        """Changes that wait."""
        self._ends: deque[float] = deque(maxlen=21)  # times at which the last steps ended
        # An environment may state no default physics; then they are the first of training.
        self._usual = self._sets.group("train")[0] | dict(self.spec.default_sim_params)
        self.sim_params = dict(self._usual)
        """The physics now in force, or at the next reset."""
        self.reset(0)

    @property
    def ranges(self) -> dict[str, tuple[float, ...] | Uniform]:
        """The values to choose from, by simulator parameter.

        Whole numbers of which one is 0 or negative are kinds, such as a leg or a sign; others are
        amounts, which go from the least to the largest of training and unseen values.
        """
        physics = [row for group in self._sets.group_names for row in self._sets.group(group)]
        groups = (self._sets.train, *self._sets.unseen.values())
        signed, found = getattr(getattr(self.env, "world", None), "signed", ()), {}
        for name, usual in self._usual.items():
            values = {float(usual)} | ({-1.0, 1.0} if name in signed else set())
            values |= {row[name] for row in physics if name in row}
            whole = not any(isinstance(group.get(name), Uniform) for group in groups)
            kinds = whole and min(values) <= 0 and all(value.is_integer() for value in values)
            if len(values) > 1:
                ends = Uniform(min(values), max(values))
                found[name] = tuple(sorted(values)) if kinds else ends
        return found

    @property
    def pace(self) -> float:
        """Steps per second of late, relative to the speed that is wanted."""
        taken = self._ends[-1] - self._ends[0] if len(self._ends) > 1 else 0.0
        return (len(self._ends) - 1) / taken / (self.rate * self.speed) if taken else 1.0

    def reset(self, seed: int | None = None) -> None:
        """Begin another episode, under the physics now in force."""
        with raising(self.spec.name, "reset"):
            obs, _ = self.env.reset(seed=seed, options={"sim_params": self._varied()})
        self.controller.reset(self.sim_params)
        self.obs, self._changed = obs[0], False
        self.moments.clear()

    def set_sim_params(self, values: Mapping[str, float]) -> None:
        """Change some simulator parameters; a model that is told them is told, and forgets.

        An environment that cannot do so in the middle of an episode begins another one.

        Raises:
            ConfigError: A parameter or value is not allowed.
        """
        able = [one.has_wrapper_attr("set_sim_params") for one in getattr(self.env, "envs", ())]
        if all(able):
            self.env.set_sim_params(0, {**self._varied(), **values})
        self.sim_params |= values
        self._changed = True
        if not all(able):
            self.reset()
        elif self.controller.agent.sim_param_names:
            self.controller.reset(self.sim_params)

    def push(self, change: float) -> None:
        """Change a velocity at once: of the pendulum (rad/s), or of cart or robot forward (m/s)."""
        world, state = self.env.world, self.env.get_state(0)
        state[world.nominal.nq if hasattr(world, "nominal") else 1] += change
        self.env.set_state(0, state)
        self.obs = self.env.observe()[0]

    def switch(self, settings: Mapping[str, Any]) -> None:
        """Go on with the same model and other settings of `planner`, by dotted name.

        Raises:
            ConfigError: A setting is unknown, of the wrong type or out of range.
        """
        self.controller = load(self._run_dir, settings=settings)
        self.controller.reset(self.sim_params)

    def step(self) -> None:
        """Plan, act, and remember what happened; an episode that ends is begun anew.

        Raises:
            BadEnvironmentError: The environment broke, or raised.
        """
        try:
            action = self.controller.act(self.obs)
        except PlanningError as error:  # no plan is left: begin again
            self.message = str(error)
            self.reset()
            return
        status, imagined = self.controller.status, self.controller.imagine()
        with raising(self.spec.name, "a step"):
            obs, reward, ends, cut, info = self.env.step(np.asarray(action)[None])
        if "broken" in info:
            self.message = f"{self.spec.name} broke: {info['broken'][0]}"
            self.reset()
            return
        self.obs, mean = obs[0], None if imagined is None else imagined.mean(0)
        seconds = status.seconds if status else 0.0
        about = float(reward[0]), self.controller.heads, seconds, self._changed
        self.moments.append(Moment(self.obs, mean, *about))
        self._changed = False
        if ends[0] or cut[0]:
            self.message = "The episode ended; another one begins."
            self.reset()

    def ask(self, change: Callable[[], Any]) -> None:
        """Have something done between two steps; any thread may ask."""
        self.asked.put(change)

    def run(self, show: Callable[[], None], watched: Callable[[], Any] = lambda: True) -> None:
        """Step in real time until `stopped`; steps that are late are not made up for.

        Args:
            show: Called after every step and every change.
            watched: Asked whether anybody looks; after the first step nothing moves if not.
        """
        due = time.perf_counter()
        while not self.stopped:
            idle = self.paused or (self.moments and not watched())
            if idle:
                self._ends.clear()  # a rest is no delay
            wait = IDLE_S if idle else max(due - time.perf_counter(), 0.0)
            try:
                change = self.asked.get(timeout=min(wait, IDLE_S))
            except queue.Empty:
                if wait > 0:
                    continue
                change = None
            if change is not None:
                self.message = ""
                self._ends.clear()
            try:
                (change or self.step)()
            except HeadwayError as error:
                self.message = str(error)
                self.paused |= change is None
            if change is None:
                now = time.perf_counter()
                self._ends.append(now)
                due = max(due + 1 / (self.rate * self.speed), now)
            show()

    def _varied(self) -> dict[str, float]:
        """What `reset` may be told: of an environment of one's own the parameters of its sets."""
        known = self.sim_params if hasattr(self.env, "world") else self._sets.names
        return {name: self.sim_params[name] for name in known}
