"""Episodes and fits that an interrupted attempt began, taken up where it stood.

Of an episode the actions are kept, and made again.
"""

import hashlib
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import jax
import numpy as np
from jaxtyping import Float, Int

from headway.experiment.arrays import tree_arrays, tree_from_arrays
from headway.experiment.files import damaged
from headway.experiment.progress_store import Part, ProgressStore
from headway.experiment.rollouts import (
    AgentPolicy,
    Arena,
    Episode,
    Policy,
    Rollout,
    run_episodes,
)
from headway.experiment.storage import trajectories_from, trajectory_arrays, trajectory_facts
from headway.models.fitting import EpochStats, FitState


class _NotRepeatableError(Exception):
    """The same actions led elsewhere than the first time."""


class Recorder:
    """An agent's policy that keeps its actions, and first repeats those of an earlier attempt.

    Planning takes nearly all the time of an episode, so making the actions again is quick. It
    leads to the same place, to the bit, or is noticed.

    Args:
        policy: Chooses the actions.
        store: Keeps them.
        name: Of the part.
    """

    def __init__(self, policy: AgentPolicy, store: ProgressStore, name: str):
        self._policy, self._store, self._name = policy, store, name
        self._actions: list[np.ndarray] = []
        self._failures: list[np.ndarray] = []
        self._seen = hashlib.sha256()
        self._step = 0
        self._known = 0
        self._wanted = ""
        part = store.load(name)
        if part is not None:
            self._restore(part, store.path(name))

    def __call__(
        self, obs: Float[np.ndarray, "env obs"]
    ) -> tuple[Float[np.ndarray, "env action"], Int[np.ndarray, " env"]]:
        """Choose an action, or repeat it."""
        self._seen.update(np.ascontiguousarray(obs).tobytes())
        self._step += 1
        if self._step > self._known:
            action, failures = self._policy(obs)
            self._actions.append(action)
            self._failures.append(failures)
            self._store.offer(self._name, self._part)
        elif self._step == self._known and self._seen.hexdigest() != self._wanted:
            raise _NotRepeatableError
        return self._actions[self._step - 1], self._failures[self._step - 1]

    def _part(self) -> Part:
        made = {"action": np.stack(self._actions), "failures": np.stack(self._failures)}
        state = tree_arrays(self._policy.state, "state.")
        return Part({**made, **state}, {"seen": self._seen.hexdigest()})

    def _restore(self, part: Part, path: Path) -> None:
        state, arrays = self._policy.state, part.arrays
        self._policy.state = tree_from_arrays(state, arrays, path, "state.")
        try:
            actions, failures, self._wanted = (
                arrays["action"],
                arrays["failures"],
                part.facts["seen"],
            )
        except KeyError as error:
            raise damaged(path, f"it lacks {error}") from None
        if actions.shape != (len(failures), *state.action.shape) or failures.ndim != 2:
            raise damaged(path, "its actions are of another environment")
        self._actions, self._failures = list(actions), list(failures)
        self._known = len(actions)


def resumable_episodes(
    store: ProgressStore,
    name: str,
    arena: Arena,
    episodes: Sequence[Episode],
    make_policy: Callable[[], Policy],
    on_step: Callable[[int], None],
) -> Rollout:
    """Run episodes as `run_episodes` does, from wherever an interrupted attempt stood.

    Args:
        store: Keeps what is done.
        name: Of the part that the episodes are.
        arena: The environments.
        episodes: Physics and seeds.
        make_policy: Makes the policy that chooses the actions; it is the same every time.
        on_step: Called after each step with the number of environments that stepped.
    """
    part = store.load(name)
    if part is not None:
        on_step(len(episodes) * arena.episode_length)
        return _restore(part, len(episodes), store.path(name))
    tape = f"{name}-actions"

    def policy() -> Policy:
        made = make_policy()
        # Random actions are as quick to draw again.
        return Recorder(made, store, tape) if isinstance(made, AgentPolicy) else made

    def after_step(steps: int) -> None:
        on_step(steps)
        store.stop_if_asked()

    try:
        rollout = run_episodes(arena, episodes, policy(), after_step)
    except _NotRepeatableError:
        store.drop(tape)
        rollout = run_episodes(arena, episodes, policy(), after_step)
    store.drop(tape)
    store.offer(name, lambda: _finished(rollout))
    return rollout


def _finished(rollout: Rollout) -> Part:
    facts = trajectory_facts(rollout.trajectories)
    kept = {"trajectories": facts, "planner_failures": rollout.planner_failures}
    return Part(trajectory_arrays(rollout.trajectories), kept)


def _restore(part: Part, num_episodes: int, path: Path) -> Rollout:
    facts, failures = (part.facts.get(name) for name in ("trajectories", "planner_failures"))
    trajectories = trajectories_from(part.arrays, facts, path)
    if len(trajectories) != num_episodes or not isinstance(failures, int):
        raise damaged(path, f"it does not hold {num_episodes} episodes")
    return Rollout(trajectories, failures)


def fit_part(state: FitState, history: list[EpochStats]) -> Part:
    """A fit after some epochs, to be kept."""
    stats = jax.tree.map(lambda *values: np.stack(values), *history)
    return Part({**tree_arrays(state, "state."), **tree_arrays(stats, "stats.")}, {})


def fitted_before(store: ProgressStore, fresh: FitState) -> tuple[FitState, list[EpochStats]]:
    """The fit that an interrupted attempt kept, or the one to begin with."""
    part = store.load("fit")
    if part is None:
        return fresh, []
    path = store.path("fit")
    try:
        columns: list[Any] = [part.arrays[f"stats.{name}"] for name in EpochStats._fields]
        history = [EpochStats(*row) for row in zip(*columns, strict=True)]
    except (KeyError, TypeError, ValueError) as error:
        raise damaged(path, f"it holds no epochs: {error}") from None
    return tree_from_arrays(fresh, part.arrays, path, "state."), history
