"""Episodes and fits that an interrupted attempt began, taken up where it stood.

Of an episode the actions are kept, and made again.
"""

import dataclasses
import hashlib
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, TypeGuard

import jax
import numpy as np
from jaxtyping import Float

from headway.errors import RunError
from headway.experiment.rollouts import (
    AgentPolicy,
    Arena,
    Choice,
    Episode,
    PlannerUse,
    Policy,
    Rollout,
    run_episodes,
)
from headway.models.fitting import FitState
from headway.models.updates import EpochStats
from headway.storage.arrays import tree_arrays, tree_from_arrays
from headway.storage.files import damaged
from headway.storage.progress_store import Part, ProgressStore
from headway.storage.records import trajectories_from, trajectory_arrays, trajectory_facts
from headway.training.progress import Progress

_KEPT = ("action", "failures", "evaluations")  # of every choice


class _NotRepeatableError(Exception):
    """The same actions led elsewhere than the first time, or cannot be read."""


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
        self._choices: list[Choice] = []
        self._seen = hashlib.sha256()
        self._step = 0
        self._known = 0
        self._wanted = ""
        part = store.load(name)
        if part is not None:
            try:
                self._restore(part, store.path(name))
            except RunError as error:  # kept by another version
                raise _NotRepeatableError from error

    def __call__(self, obs: Float[np.ndarray, "env obs"]) -> Choice:
        """Choose an action, or repeat it."""
        self._seen.update(np.ascontiguousarray(obs).tobytes())
        self._step += 1
        if self._step > self._known:
            choice = self._policy(obs)
            if self._step == self._known + 1:  # it may compile
                choice = choice._replace(timed=False)
            self._choices.append(choice)
            self._store.offer(self._name, self._part)
        elif self._step == self._known and self._seen.hexdigest() != self._wanted:
            raise _NotRepeatableError
        return self._choices[self._step - 1]

    def check_repeated(self) -> None:
        """Make sure that the episodes did not end before the actions of the earlier attempt.

        Raises:
            _NotRepeatableError: They did.
        """
        if self._step < self._known:
            raise _NotRepeatableError

    def _part(self) -> Part:
        made = {
            name: np.stack([getattr(choice, name) for choice in self._choices]) for name in _KEPT
        }
        state = tree_arrays(self._policy.state, "state.")
        return Part({**made, **state}, {"seen": self._seen.hexdigest()})

    def _restore(self, part: Part, path: Path) -> None:
        state = self._policy.state
        self._policy.state = tree_from_arrays(state, part.arrays, path, "state.")
        try:
            kept = [part.arrays[name] for name in _KEPT]
            self._wanted = part.facts["seen"]
        except KeyError as error:
            raise damaged(path, f"it lacks {error}") from None
        actions, *counts = kept
        shape = (len(actions), *state.action.shape)
        if actions.shape != shape or any(count.shape != shape[:2] for count in counts):
            raise damaged(path, "its actions are of another environment")
        self._choices = [Choice(*row, timed=False) for row in zip(*kept, strict=True)]
        self._known = len(actions)


def went_back(good: int | None) -> str:
    """Word where a run goes on after a damage."""
    return "begins anew" if good is None else f"goes on after iteration {good}, which is intact"


def take_up(store: ProgressStore, progress: Progress) -> None:
    """Open what is done of the unfinished iteration, or nothing where that is damaged."""
    try:
        store.open()
    except RunError as error:
        progress.message(f"{error} It is not used: the iteration begins anew.")
        store.clear()


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
    finished = _finished_before(store, name, len(episodes))
    if finished is not None:
        on_step(len(episodes) * arena.episode_length)
        return finished
    tape = f"{name}-actions"

    def after_step(steps: int) -> None:
        on_step(steps)
        store.stop_if_asked()

    def run() -> Rollout:
        policy = make_policy()
        if not isinstance(policy, AgentPolicy):  # random actions are as quick to draw again
            return run_episodes(arena, episodes, policy, after_step)
        recorder = Recorder(policy, store, tape)
        rollout = run_episodes(arena, episodes, recorder, after_step)
        recorder.check_repeated()
        return rollout

    try:
        rollout = run()
    except _NotRepeatableError:
        store.drop(tape)
        rollout = run()
    store.drop(tape)
    store.offer(name, lambda: _finished(rollout))
    return rollout


def _finished_before(store: ProgressStore, name: str, num_episodes: int) -> Rollout | None:
    """The episodes that an interrupted attempt finished; None where this version cannot read them.

    That their file is as it was written is known since `take_up`.
    """
    part = store.load(name)
    if part is None:
        return None
    try:
        return _restore(part, num_episodes, store.path(name))
    except RunError:
        store.drop(name)
        return None


def _finished(rollout: Rollout) -> Part:
    facts = trajectory_facts(rollout.trajectories)
    use = dataclasses.asdict(rollout.use)
    broken = [[number, reason] for number, reason in rollout.broken.items()]
    kept = {"trajectories": facts, "use": use, "broken": broken}
    return Part(trajectory_arrays(rollout.trajectories), kept)


def _restore(part: Part, num_episodes: int, path: Path) -> Rollout:
    trajectories = trajectories_from(part.arrays, part.facts.get("trajectories"), path)
    use = part.facts.get("use")
    broken = part.facts.get("broken", [])
    if not _are_broken(broken, num_episodes) or not _is_use(use):
        raise damaged(path, "it does not say what broke, or what planning took")
    rollout = Rollout(trajectories, PlannerUse(**use), dict(broken))
    if len(trajectories) + len(rollout.broken) != num_episodes:
        raise damaged(path, f"it does not hold {num_episodes} episodes")
    return rollout


def _are_broken(values: Any, num_episodes: int) -> bool:
    """Whether something read from a file is numbers of episodes and reasons."""
    return isinstance(values, list) and all(
        isinstance(value, list)
        and [type(entry) for entry in value] == [int, str]
        and 0 <= value[0] < num_episodes
        for value in values
    )


def _is_use(values: Any) -> TypeGuard[dict[str, Any]]:
    """Whether something read from a file is what planning took, by name."""
    types = {name: type(value) for name, value in dataclasses.asdict(PlannerUse()).items()}
    return isinstance(values, dict) and {n: type(v) for n, v in values.items()} == types


def fit_part(state: FitState, history: list[EpochStats], rollbacks: int) -> Part:
    """A fit after some epochs, to be kept."""
    stats = jax.tree.map(lambda *values: np.stack(values), *history)
    arrays = {**tree_arrays(state, "state."), **tree_arrays(stats, "stats.")}
    return Part(arrays, {"rollbacks": rollbacks})


def fitted_before(store: ProgressStore, fresh: FitState) -> tuple[FitState, list[EpochStats], int]:
    """The fit that an interrupted attempt kept, or the one to begin with; and its roll-backs.

    One that another version kept is made anew.
    """
    part = store.load("fit")
    if part is None:
        return fresh, [], 0
    try:
        return _fit_from(part, fresh, store.path("fit"))
    except RunError:
        store.drop("fit")
        return fresh, [], 0


def _fit_from(part: Part, fresh: FitState, path: Path) -> tuple[FitState, list[EpochStats], int]:
    try:
        columns: list[Any] = [part.arrays[f"stats.{name}"] for name in EpochStats._fields]
        history = [EpochStats(*row) for row in zip(*columns, strict=True)]
        rollbacks = int(part.facts.get("rollbacks", 0))
    except (KeyError, TypeError, ValueError) as error:
        raise damaged(path, f"it holds no epochs: {error}") from None
    return tree_from_arrays(fresh, part.arrays, path, "state."), history, rollbacks
