"""One robot's controller: observations in, actions out, in the environment's own units."""

import math
import time
import warnings
from collections import deque
from collections.abc import Callable, Mapping
from typing import Any, Literal, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int
from numpy.typing import ArrayLike

from headway.errors import ConfigError, PlanningError, shown
from headway.models.compilation import jit_networks
from headway.planning.agent import Agent, AgentState, Decision, open_loop
from headway.planning.optimizers.ilqr import Policy
from headway.planning.rollouts import follow
from headway.task import env_action, scaled_action

REMEMBERED = 32
"""Calls whose durations are remembered."""
CONSTANT = 0.01
"""Distance from its only value in training that a feature may have, relative to it or to 1."""
MARGIN = 0.1
"""Distance from its bounds that an action which was measured may have, relative to theirs."""


class Status(NamedTuple):
    """The way in which an action was found."""

    outcome: Literal["planned", "deadline", "held"]
    """`planned`: the search ended. `deadline`: it was cut off, and the action is the best so far.
    `held`: there is no new plan, and the action is the next one of the plan before."""
    reason: str
    """Why the search was cut off or failed; empty where it ended."""
    warnings: tuple[str, ...]
    """Features of the observation that are unlike the training data."""
    iterations: int
    """Iterations of the planner."""
    seconds: float
    """From the call of `act` to the action."""


class Controller:
    """Acts with a trained agent, one step at a time.

    An observation of the wrong shape is an error. One that is not finite is not: the robot must
    go on, so the controller holds to its last plan (open loop), as it does where planning finds
    nothing finite or no iteration fits the deadline. A plan lasts `planner.horizon` steps; a
    controller that has none left raises. An observation unlike the training data is planned with,
    and `status.warnings` says what is off.

    Args:
        agent: The trained agent.
        seed: Seeds the planner's draws.
        deadline_ms: Milliseconds after which `act` answers with the best plan so far; None plans
            to the end. Everything that `act` can need is compiled and timed first, while the
            controller is built.
            Where no earlier plan is left, as in the first step, one iteration is made even if
            it is late. So a deadline in which no iteration fits, which is warned of, is kept by
            all steps but one in `planner.horizon`. The promise is that of a program in Python:
            `status.seconds` has what a step took, with any pause of the system.
        max_deviations: Standard deviations from the mean of the training data at which a feature
            of an observation is reported; None does not look.
        clock: Tells the seconds.

    Raises:
        ConfigError: The deadline is not positive, or the agent makes no plans.
    """

    status: Status | None
    """The way in which the last action was found; None before the first."""
    heads: Int[np.ndarray, " member"] | None
    """The prediction head that each member plans with now; None before the first action, and where
    the model has no heads. With `head_selection="average"`, which plans with all heads, the one
    that explains the recent past best."""

    def __init__(
        self,
        agent: Agent,
        *,
        seed: int = 0,
        deadline_ms: float | None = None,
        max_deviations: float | None = 10.0,
        clock: Callable[[], float] = time.perf_counter,
    ):
        self.agent = agent
        self._seed, self._clock, self._episode = seed, clock, -1
        self._statistics = getattr(agent.model, "statistics", None)
        self._max_deviations = max_deviations
        self._preprocess = eqx.filter_jit(agent.task.preprocess)
        self._durations = {name: deque(maxlen=REMEMBERED) for name in ("iterate", "end")}
        self._seconds = None if deadline_ms is None else deadline_ms / 1000
        if deadline_ms is not None:
            if not 0 < deadline_ms < float("inf"):
                raise ConfigError(
                    f"deadline_ms is {deadline_ms}, allowed: milliseconds above 0, or None for"
                    " none."
                )
            if agent.model is None:
                raise ConfigError(
                    f"deadline_ms is {deadline_ms:g}, but random makes no plan that could be cut"
                    " off, allowed: None; or take a method that plans, such as tmcl or pets."
                )
            self._warm_up()
        self._episode = -1
        self.reset()

    def __repr__(self) -> str:
        """One line: sizes, planner, and how the last action was found."""
        task, planner = self.agent.task, self.agent.planner
        search = f"{planner.optimizer.name}, horizon {planner.horizon}"
        search, last = search if self.agent.model else "random actions", ""
        if self.status:
            last = f"; {self.status.outcome} in {1e3 * self.status.seconds:.3g} ms"
        if self.heads is not None:
            last += f", heads {' '.join(map(str, self.heads))}"
        return f"Controller({task.obs_size} numbers in, {task.action_size} out; {search}{last})"

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
        self.heads = self.status = None
        self._left = 0  # steps of the last plan that are still to come

    def act(
        self, obs: ArrayLike, *, applied_action: ArrayLike | None = None
    ) -> np.ndarray | np.integer:
        """Choose the next action.

        Args:
            obs: The observation, as the environment returned it; one number per entry.
            applied_action: The action that led here, in the environment's own units, where it is
                not the one that the last call returned: a safety layer limited it, or an
                operator took over. Heads are chosen and contexts computed from what was applied.
                An entry that is not finite says that it is not known; nothing is learned from
                that step then. At the first call of an episode no action counts.

        Returns:
            The action, as `env.step` takes it: in the environment's own units, of its type and
            within its bounds.

        Raises:
            ConfigError: The observation or the applied action has another shape, the applied
                action is out of bounds, or the model wants to be told the simulator parameters
                and was not.
            PlanningError: There is no new plan, and no earlier one is left.
        """
        started, task = self._clock(), self.agent.task
        if self._state is None:
            names = ", ".join(self.agent.sim_param_names)
            raise ConfigError(
                f"the controller was told no sim_params, allowed: a value for each of {names},"
                ' which its model takes as input; call reset(sim_params=info["sim_params"]) first.'
            )
        advice = "pass one observation as the environment returns it"
        row = _row("obs", obs, (task.obs_size,), advice)
        if applied_action is not None:
            self._correct(applied_action)
        finite = np.isfinite(row)
        if not finite.all():
            entry = int(np.argmin(finite))
            reason = f"obs[{entry}] is {row[entry]}, allowed: finite numbers; check the sensor"
            self._count_left(held=True, reason=reason)
            action = self._hold()
            self.status = Status("held", reason, (), 0, self._clock() - started)
            return action
        unlike = self._unlike_training(row)
        decision, done = self._search(row, started)
        scaled, heads, failures, _ = jax.device_get(decision)
        self.heads = None if heads is None else heads[0]
        reason, held = "", bool(failures[0] >= done)
        if done == 0:
            reason = "no iteration of the planner fits the deadline"
        elif held:
            reason = f"none of {done} iterations of the planner found a finite return"
        elif done < self._num_iterations:
            reason = f"time was up after {done} of {self._num_iterations} iterations"
        self._count_left(held=held, reason=reason)
        outcome = "held" if held else "deadline" if done < self._num_iterations else "planned"
        self.status = Status(outcome, reason, unlike, done, self._clock() - started)
        return env_action(task, scaled[0])

    def imagine(self) -> Float[np.ndarray, "member horizon obs"] | None:
        """Observations that each member expects along the last plan, without noise.

        The first one is its prediction of the next observation. A plan with feedback expects one
        way, by the mean of all members, and rests in its last step. None where there is no new
        plan: before the first action, while a plan is held, and where the agent makes none.
        """
        if self.agent.model is None or self.status is None or self.status.outcome == "held":
            return None
        if isinstance(self._state.search, Policy):
            return jax.device_get(self._state.search.expected)
        return jax.device_get(_imagine(self.agent, self._state))[:, 0]

    @property
    def _num_iterations(self) -> int:
        return 1 if self.agent.model is None else self.agent.planner.num_iterations

    def _search(self, obs: Float[np.ndarray, " obs"], started: float) -> tuple[Decision, int]:
        """Plan to the end, or iteration by iteration as long as there is time.

        Between two iterations the clock is read, and another one begins only if the slowest of
        the last ones would still fit. So the answer is late only where a part takes longer than
        it lately did, by that much.

        Returns:
            The decision, and the number of iterations that were made.
        """
        if self._seconds is None:
            self._state, decision = self.agent.act(self._state, obs[None])
            return decision, self._num_iterations
        until, done = started + self._seconds, 0
        at_least = 0 if self._left > 0 else 1  # without a plan there is nothing else to do
        plan = self.agent.begin(self._state, jnp.asarray(obs[None]))
        while done < self._num_iterations:
            slowest = sum(max(durations, default=0.0) for durations in self._durations.values())
            if done >= at_least and self._clock() + slowest > until:
                break
            plan = self._timed("iterate", plan, done)
            done += 1
        if done == 0:  # one hiccup is not remembered for long, the quickest call always
            for durations in self._durations.values():
                if len(durations) > 1:
                    durations.remove(max(durations))
        self._state, decision = self._timed("end", plan)
        return decision, done

    def _timed(self, name: str, *args: Any) -> Any:
        started = self._clock()
        found = jax.block_until_ready(getattr(self.agent, name)(*args))
        self._durations[name].append(self._clock() - started)
        return found

    def _warm_up(self) -> None:
        """Live through all that `act` can meet, so that everything is compiled and timed."""
        self.reset(dict.fromkeys(self.agent.sim_param_names, 1.0))
        task, obs = self.agent.task, np.zeros(self.agent.task.obs_size, np.float32)
        self._unlike_training(obs)
        in_time, late = float("inf"), -float("inf")
        for self._left, started in ((0, in_time), (1, in_time), (1, late), (0, late)):
            self._search(obs, started)
        for numbers in (task.action_low, np.full(len(task.action_low), np.nan)):
            self._correct(np.reshape(numbers, task.spaces.action_shape))
        self._hold()
        for _ in range(3):
            for durations in self._durations.values():
                durations.clear()  # the first times are those of compiling
            self._search(obs, in_time)
        self._left = 1
        if self._seconds and not any(self._search(obs, self._clock())[1] for _ in range(3)):
            least = sum(map(min, self._durations.values()))
            horizon = self.agent.planner.horizon
            warnings.warn(
                f"deadline_ms is {1000 * self._seconds:g}, but an iteration of the planner takes"
                f" {1000 * least:.4g} here: one step in {horizon} makes a plan and is late, the"
                " others hold to it without a look; allow more, or choose a cheaper planner.",
                stacklevel=3,
            )

    def _hold(self) -> np.ndarray | np.integer:
        """The next action of the last plan, without a look (open loop)."""
        self._state = open_loop(self.agent, self._state)
        return env_action(self.agent.task, jax.device_get(self._state.action)[0])

    def _count_left(self, *, held: bool, reason: str) -> None:
        """Count the steps of the plan that are left.

        Raises:
            PlanningError: The plan is to be held, and none is.
        """
        if not held:
            self._left = 0 if self.agent.model is None else self.agent.planner.horizon - 1
        elif self._left <= 0:
            # No action leads from here to the next observation.
            self._state = self._state._replace(acted=np.zeros_like(self._state.acted))
            raise PlanningError(
                f"{reason}, and no earlier plan is left, allowed: to hold to a plan for at most"
                " planner.horizon - 1 steps; stop the robot, then call reset()."
            )
        else:
            self._left -= 1

    def _correct(self, applied_action: Any) -> None:
        """Let the last step be remembered with the action that was applied, if it is known.

        Raises:
            ConfigError: It has another shape, or lies outside of its bounds by more than `MARGIN`.
        """
        task = self.agent.task
        advice = "pass one action in the environment's units, as `act` returns it"
        action = _row("applied_action", applied_action, task.spaces.action_shape, advice).ravel()
        if not np.isfinite(action).all():
            self._state = self._state._replace(acted=jnp.asarray(np.zeros(1, bool)))
            return
        low, high = np.asarray(task.action_low), np.asarray(task.action_high)
        margin = MARGIN * (high - low)
        outside = (action < low - margin) | (action > high + margin)
        if outside.any():
            i = int(np.argmax(outside))
            raise ConfigError(
                f"applied_action[{i}] is {action[i]:g}, allowed: from {low[i]:g} to {high[i]:g},"
                f" and {margin[i]:g} beyond for what was measured; {advice}."
            )
        self._state = self._state._replace(action=jnp.asarray(scaled_action(task, action)[None]))

    def _unlike_training(self, obs: Float[np.ndarray, " obs"]) -> tuple[str, ...]:
        """Word the features that are off; empty where all are as in training.

        Mean and spread are all that is kept of the training data. A feature is what
        `Task.preprocess` makes of an observation, mostly an entry of it.
        """
        if self._max_deviations is None or self._statistics is None:
            return ()
        features = self._statistics.features
        mean, std = np.asarray(features.mean), np.asarray(features.std)
        off = np.abs(jax.device_get(self._preprocess(jnp.asarray(obs))) - mean)
        constant = CONSTANT * np.maximum(np.abs(mean), 1.0)
        allowed = np.where(std == 0, constant, self._max_deviations * std)
        return tuple(
            f"feature {i} is off by {off[i]:.3g} from {mean[i]:.3g}, its only value in training"
            if std[i] == 0
            else f"feature {i} is {off[i] / std[i]:.3g} standard deviations from its mean in"
            f" training, allowed: {self._max_deviations:g}"
            for i in np.flatnonzero(~(off <= allowed))
        )


@jit_networks
def _imagine(agent: Agent, state: AgentState) -> Float[Array, "member env horizon obs"]:
    assert agent.model is not None
    plan = jnp.concatenate([state.action[:, None], state.search.nominal[:, :-1]], axis=1)
    dynamics = agent.model.dynamics(state.belief, agent.planner.precision)
    return follow(dynamics, state.obs, agent.task.project_action(plan))


def _row(name: str, given: Any, shape: tuple[int, ...], advice: str) -> Float[np.ndarray, "..."]:
    """Numbers of float32.

    Raises:
        ConfigError: It has another shape, or is no numbers.
    """
    try:
        with np.errstate(over="ignore"):  # what is too large becomes infinite
            row = np.asarray(given).astype(np.float32)
    except (TypeError, ValueError):
        allowed = f"{math.prod(shape)} numbers"
        raise ConfigError(f"{name} is {shown(given)}, allowed: {allowed}; {advice}.") from None
    if row.shape != shape:
        raise ConfigError(f"{name} has shape {row.shape}, allowed: {shape}; {advice}.")
    return row
