"""One robot's controller: observations in, actions out, in the environment's own units."""

import time
from collections.abc import Callable, Mapping
from typing import Any, Literal, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Int
from numpy.typing import ArrayLike

from headway.config import PlannerConfig
from headway.errors import ConfigError, PlanningError
from headway.models.multi_headed import Statistics
from headway.planning.agent import Agent, open_loop
from headway.planning.checking import RangeCheck, in_bounds, not_finite, one_row
from headway.planning.deadline import DeadlinePlanner
from headway.task import env_action, scaled_action


class Status(NamedTuple):
    """How an action was found."""

    outcome: Literal["planned", "deadline", "held"]
    """`planned`: the search ended. `deadline`: it was cut off, and the action is the best so far.
    `held`: there is no new plan, and the action is the next one of the plan before."""
    reason: str
    """Why the search was cut off or failed; empty where it ended."""
    warnings: tuple[str, ...]
    """What of the observation is unlike the training data."""
    iterations: int
    """Iterations of the planner."""
    seconds: float
    """From the call of `act` to the action."""


class _Found(NamedTuple):
    """What planning came to."""

    action: Float[np.ndarray, " action"]
    """In [-1, 1]."""
    failures: int
    """Iterations without any finite return."""
    iterations: int
    complete: bool
    """Whether the search ended by itself."""


class Controller:
    """Acts with a trained agent, one step at a time.

    An observation of the wrong shape is an error. One that is not finite is not: the robot must
    go on, so the controller holds to its last plan, as it does where planning finds nothing
    finite or no iteration fits the deadline. A plan lasts `planner.horizon` steps; a controller
    that has none left raises. An observation unlike the training data is planned with, and
    `status.warnings` says what is off.

    Args:
        agent: The trained agent.
        seed: Seeds the planner's draws.
        deadline_ms: Milliseconds after which `act` answers with the best plan so far; None plans
            to the end. Everything that `act` can need is compiled and timed first, while the
            controller is built.
            Where no earlier plan is left, as in the first step, one iteration is made even if
            it is late. The promise is that of a program in Python: `status.seconds` has what a
            step took, with any pause of the system.
        max_deviations: Standard deviations from the mean of the training data at which a feature
            of an observation is reported; None does not look.

    Raises:
        ConfigError: The deadline is not positive, or the agent cannot plan to a deadline.
    """

    def __init__(
        self,
        agent: Agent,
        *,
        seed: int = 0,
        deadline_ms: float | None = None,
        max_deviations: float | None = 10.0,
    ):
        self.agent = agent
        self._seed, self._episode = seed, -1
        self._range = self._deadline = None
        statistics: Statistics | None = getattr(agent.model, "statistics", None)
        if statistics is not None and max_deviations is not None:
            self._range = RangeCheck(agent.task, statistics.features, max_deviations)
        if deadline_ms is not None:
            self._deadline = self._planner_to(deadline_ms)
            self._rehearse(self._deadline)
        self._episode = -1
        self.reset()

    def reset(self, sim_params: Mapping[str, float] | None = None) -> None:
        """Forget the past; call it when an episode begins or the physics may have changed.

        Args:
            sim_params: The true simulator parameters, as in `info["sim_params"]`. Only a model
                with `model.context="sim-params"` looks at them; it cannot act without.

        Raises:
            ConfigError: A simulator parameter that the model is told has no value.
        """
        self._episode += 1
        key = jax.random.fold_in(jax.random.key(self._seed), self._episode)
        self._state: Any = None
        if sim_params is not None or not self.agent.sim_param_names:
            self._state = self.agent.init(1, key=key, sim_params=[sim_params or {}])
        self._heads: Int[np.ndarray, " member"] | None = None
        self._status: Status | None = None
        self._left = 0  # steps of the last plan that are still to come

    def act(
        self, obs: ArrayLike, *, applied_action: ArrayLike | None = None
    ) -> Float[np.ndarray, " action"]:
        """Choose the next action.

        Args:
            obs: The observation, as the environment returned it; one number per entry.
            applied_action: The action that led here, in the environment's own units, where it is
                not the one that the last call returned: a safety layer limited it, or an
                operator took over. Heads are chosen and contexts computed from what was applied.
                An entry that is not finite says that it is not known; nothing is learned from
                that step then. At the first call of an episode no action counts.

        Returns:
            The action, in the environment's own units and within its bounds.

        Raises:
            ConfigError: The observation or the applied action has another shape, the applied
                action is out of bounds, or the model wants to be told the simulator parameters
                and was not.
            PlanningError: There is no new plan, and no earlier one is left.
        """
        started = time.perf_counter()
        entries = self._checked(obs)
        if applied_action is not None:
            self._correct(applied_action)
        problem = not_finite(entries)
        if problem is not None:
            return self._hold(f"{problem}; check the sensor", started)
        warnings = self._range(entries) if self._range else ()
        found = self._plan(entries, started)
        done, reason = found.iterations, ""
        if done == 0:
            reason = "no iteration of the planner fits the deadline"
        elif found.failures >= done:
            reason = f"none of {done} iterations of the planner found a finite return"
        elif not found.complete:
            reason = f"time was up after {done} of {self._num_iterations} iterations"
        failed = found.failures >= done
        self._count(failed, reason)
        outcome = "held" if failed else "planned" if found.complete else "deadline"
        self._status = Status(outcome, reason, warnings, done, time.perf_counter() - started)
        return env_action(self.agent.task, found.action)

    @property
    def status(self) -> Status | None:
        """How the last action was found; None before the first."""
        return self._status

    @property
    def heads(self) -> Int[np.ndarray, " member"] | None:
        """The prediction head that each member plans with now.

        None before the first action, and where the model has no heads.

        With `head_selection="average"`, which plans with all heads, the one that explains the
        recent past best.
        """
        return self._heads

    @property
    def _planner(self) -> PlannerConfig | None:
        """Settings of the planner, of an agent that plans."""
        return self.agent.planner if self.agent.model is not None else None

    @property
    def _num_iterations(self) -> int:
        return self._planner.num_iterations if self._planner else 1

    def _planner_to(self, deadline_ms: float) -> DeadlinePlanner:
        if not 0 < deadline_ms < float("inf"):
            raise ConfigError(
                f"deadline_ms is {deadline_ms}, allowed: milliseconds above 0, or None for none."
            )
        if self.agent.model is None:
            raise ConfigError(
                f"deadline_ms is {deadline_ms:g}, but random makes no plan that could be cut"
                " off, allowed: None; or take a method that plans, such as tmcl or pets."
            )
        return DeadlinePlanner(self.agent, deadline_ms / 1000)

    def _rehearse(self, planner: DeadlinePlanner) -> None:
        """Live through all that `act` can meet, so that everything is compiled and timed."""
        self.reset(dict.fromkeys(self.agent.sim_param_names, 1.0))
        obs = np.zeros(self.agent.task.obs_size, np.float32)
        soon, late = float("inf"), -float("inf")
        for left, started in ((0, soon), (1, soon), (1, late), (0, late)):
            if self._range:
                self._range(obs)
            self._left = left
            self._plan(obs, started)
        for action in (self.agent.task.action_low, np.full(self.agent.task.action_size, np.nan)):
            self._correct(action)
        self._left = 1
        self._hold("a rehearsal", soon)
        planner.warm_up()

    def _plan(self, obs: Float[np.ndarray, " obs"], started: float) -> "_Found":
        """Search for a plan, as long as there is time, and remember where that led."""
        if self._deadline is None:
            self._state, decision = self.agent.act(self._state, obs[None])
            done, complete = self._num_iterations, True
        else:
            at_least = 0 if self._left > 0 else 1  # there is nothing else to do
            self._state, decision, done, complete = self._deadline.act(
                self._state, obs[None], started, at_least
            )
        action, heads, failures = jax.device_get(
            (decision.action[0], decision.heads, decision.failures[0])
        )
        self._heads = None if heads is None else heads[0]
        return _Found(action, int(failures), done, complete)

    def _checked(self, obs: Any) -> np.ndarray:
        """An observation of the right shape, of a controller that was told what it must be."""
        if self._state is None:
            names = ", ".join(self.agent.sim_param_names)
            raise ConfigError(
                f"the controller was told no sim_params, allowed: a value for each of {names},"
                ' which its model takes as input; call reset(sim_params=info["sim_params"]) first.'
            )
        advice = "pass one observation as the environment returns it"
        return one_row("obs", obs, self.agent.task.obs_size, advice)

    def _correct(self, applied_action: Any) -> None:
        """Let the last step be remembered with the action that was applied, if it is known."""
        task = self.agent.task
        advice = "pass one action in the environment's units, as `act` returns it"
        action = one_row("applied_action", applied_action, task.action_size, advice)
        if self._planner is None:  # an agent that remembers no actions
            return
        if np.isfinite(action).all():
            in_bounds("applied_action", action, task)
            scaled = jnp.asarray(scaled_action(task, action)[None])
            self._state = self._state._replace(action=scaled)
        else:
            self._state = self._state._replace(acted=jnp.asarray(np.zeros(1, bool)))

    def _hold(self, reason: str, started: float) -> Float[np.ndarray, " action"]:
        """The next action of the last plan."""
        self._count(True, reason)
        planner: Any = self._planner  # there is a plan to hold to
        self._state = _held(planner, self._state)
        scaled = jax.device_get(self._state.action[0])
        self._status = Status("held", reason, (), 0, time.perf_counter() - started)
        return env_action(self.agent.task, scaled)

    def _count(self, held: bool, reason: str) -> None:
        """Count how much of a plan is left.

        Raises:
            PlanningError: Nothing is.
        """
        if not held:
            self._left = self._planner.horizon - 1 if self._planner else 0
        elif self._left <= 0:
            raise PlanningError(
                f"{reason}, and no earlier plan is left, allowed: to hold to a plan for at most"
                " planner.horizon - 1 steps; stop the robot, then call reset()."
            )
        else:
            self._left -= 1


_held: Callable[[Any, Any], Any] = eqx.filter_jit(open_loop)
