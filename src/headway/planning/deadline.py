"""Planning until a deadline: one iteration of the optimizer after the other.

Between two iterations the clock is read, and another one begins only if the slowest of the
last ones would still fit. So the answer is late only where a part takes longer than it lately
did, by that much. A step in which nothing fits forgets the slowest of each part, so that one
hiccup is not remembered for long. The price is a return to Python after every iteration.
"""

import time
from collections import deque
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from headway.planning.agent import Agent, Decision, begin, end, iterate
from headway.planning.optimizers import make_optimizer

REMEMBERED = 32
"""Calls whose durations are remembered."""


class Outcome(NamedTuple):
    """A step that was planned until a deadline."""

    state: Any
    decision: Decision
    iterations: int
    """Iterations that were begun, and ended."""
    complete: bool
    """Whether the search ended by itself."""


class DeadlinePlanner:
    """Acts as an agent does, within a time.

    Args:
        agent: The trained agent.
        seconds: From the start of a step to its decision.
        clock: Tells the seconds.
    """

    def __init__(
        self, agent: Agent, seconds: float, clock: Callable[[], float] = time.perf_counter
    ):
        self._agent, self._seconds, self._clock = agent, seconds, clock
        self._optimizer = make_optimizer(agent.planner)
        self._parts: dict[str, Callable] = {"begin": begin, "iterate": iterate, "end": end}
        self._durations = {name: deque([0.0], REMEMBERED) for name in ("iterate", "end")}

    def warm_up(self) -> None:
        """Compile all parts, and take their times."""
        physics = [dict.fromkeys(self._agent.sim_param_names, 1.0)]
        state = self._agent.init(1, key=jax.random.key(0), sim_params=physics)
        obs = np.zeros((1, self._agent.task.obs_size), np.float32)
        for _ in range(3):
            for durations in self._durations.values():
                durations.clear()  # the first times are those of compiling
                durations.append(0.0)
            state = self.act(state, obs, started=float("inf")).state

    def act(
        self,
        state: Any,
        obs: Float[np.ndarray, "1 obs"],
        started: float,
        at_least: int = 0,
    ) -> Outcome:
        """Choose the next action.

        Args:
            state: What the agent remembers.
            obs: The observation.
            started: When the step began, by the clock.
            at_least: Iterations to make even if they are late.
        """
        until = started + self._seconds
        begun, search = self._timed("begin", state, jnp.asarray(obs))
        done = 0
        while done < self._optimizer.num_iterations:
            if done >= at_least and not self._fits(until):
                break
            search = self._timed("iterate", begun, search, done)
            done += 1
        if done == 0:
            self._forget_slowest()
        state, decision = self._timed("end", begun, search)
        complete = done == self._optimizer.num_iterations
        return Outcome(state, decision, done, complete)

    def _fits(self, until: float) -> bool:
        return self._clock() + sum(max(d) for d in self._durations.values()) <= until

    def _forget_slowest(self) -> None:
        for durations in self._durations.values():
            durations.remove(max(durations))
            if not durations:
                durations.append(0.0)

    def _timed(self, name: str, *args: Any) -> Any:
        """Call a part of the step to its end, and remember how long it took if that matters."""
        started = self._clock()
        found = jax.block_until_ready(self._parts[name](self._agent, *args))
        if name in self._durations:
            self._durations[name].append(self._clock() - started)
        return found
