"""Planning until a deadline: one iteration of the optimizer per compiled call.

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
from jaxtyping import Array, Bool, Float, PRNGKeyArray

from headway.errors import ConfigError
from headway.models.compilation import jit_networks
from headway.planning.acting import Decision
from headway.planning.devices import brought_to_each, whole_on_each
from headway.planning.optimizers import make_optimizer
from headway.planning.step import Planning, scoring

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

    Raises:
        ConfigError: The agent shares its plans with other processes, which would have to stop
            at the same iteration.
    """

    def __init__(
        self, agent: Planning, seconds: float, clock: Callable[[], float] = time.perf_counter
    ):
        if agent.planner.devices != "local":
            raise ConfigError(
                f"planner.devices is {agent.planner.devices!r}, allowed with a deadline: 'local';"
                " change it, or plan without a deadline."
            )
        self._agent, self._seconds, self._clock = agent, seconds, clock
        self._optimizer = make_optimizer(agent.planner)
        self._compiled = _COMPILED[agent.planner.precision]
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
        begin, seen = self._compiled["begin"], jnp.asarray(obs)
        state = brought_to_each(state, self._agent.planner.devices)
        prepared, keys, search = jax.block_until_ready(begin(self._agent, state, seen))
        done, settled = 0, False
        while done < self._optimizer.num_iterations and not settled:
            if done >= at_least and not self._fits(until):
                break
            kind = self._optimizer.kind(done)
            search, settled = self._timed(
                "iterate", self._agent, prepared, seen, search, keys[done], kind
            )
            settled = bool(settled.all())
            done += 1
        if done == 0:
            self._forget_slowest()
        state, decision = self._timed("end", self._agent, state, seen, prepared, search)
        complete = settled or done == self._optimizer.num_iterations
        return Outcome(state, decision, done, complete)

    def _fits(self, until: float) -> bool:
        return self._clock() + sum(max(d) for d in self._durations.values()) <= until

    def _forget_slowest(self) -> None:
        for durations in self._durations.values():
            durations.remove(max(durations))
            if not durations:
                durations.append(0.0)

    def _timed(self, name: str, *parts: Any) -> Any:
        started = self._clock()
        found = jax.block_until_ready(self._compiled[name](*parts))
        self._durations[name].append(self._clock() - started)
        return found


def _begin(
    agent: Planning, state: Any, obs: Float[Array, "env obs"]
) -> tuple[Any, list[PRNGKeyArray], Any]:
    prepared = agent.prepare(state, obs)
    optimizer = make_optimizer(agent.planner)
    keys = jax.random.split(prepared.plan_key, optimizer.num_iterations)
    begun = prepared, list(keys), optimizer.begin(state.search)
    return whole_on_each(begun, agent.planner.devices)


def _iterate(
    agent: Planning,
    prepared: Any,
    obs: Float[Array, "env obs"],
    search: Any,
    key: PRNGKeyArray,
    iteration: int,
) -> tuple[Any, Bool[Array, " env"]]:
    optimizer = make_optimizer(agent.planner)
    score = scoring(agent.task, agent.planner, prepared.dynamics, obs)
    search = optimizer.iterate(score, search, key, iteration)
    return whole_on_each((search, optimizer.settled(search)), agent.planner.devices)


def _end(
    agent: Planning, state: Any, obs: Float[Array, "env obs"], prepared: Any, search: Any
) -> tuple[Any, Decision]:
    plan = make_optimizer(agent.planner).end(search)
    return whole_on_each(agent.decide(state, obs, prepared, plan), agent.planner.devices)


_COMPILED = {
    precision: {
        name: jit_networks(function, precision=precision)
        for name, function in (("begin", _begin), ("iterate", _iterate), ("end", _end))
    }
    for precision in ("float32", "bfloat16")
}
