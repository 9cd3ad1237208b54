"""One display for several runs that go side by side."""

import threading
from collections import defaultdict
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np

from headway.experiment.progress import Phase, Progress

PHASES = ("collect", "fit", "evaluate")
"""What is done in an iteration, in this order."""

Place = tuple[int, int]
"""An iteration, and the number of a phase in it."""


class SharedProgress:
    """Shows where the run is that is least far, with the work of all runs.

    Runs are in threads of their own, and tell of themselves while they hold the `lock`.

    Args:
        shown: The display.
    """

    def __init__(self, shown: Progress):
        self.lock = threading.RLock()
        self._shown = shown
        self._runs: list[RunProgress] = []
        self._totals: dict[Place, int] = defaultdict(int)
        self._done: dict[Place, int] = defaultdict(int)
        self._finished: dict[int, list[Mapping[str, Any]]] = defaultdict(list)
        self._now: Place | None = None
        self._announced = False

    def of_run(
        self, seed: int, on_phase: Callable[[Place], None], own: Progress | None = None
    ) -> "RunProgress":
        """What one run tells its progress to.

        Args:
            seed: Of the run; names it in messages.
            on_phase: Called when the run begins a phase.
            own: Is told all of this run, and of no other.
        """
        run = RunProgress(self, seed, on_phase, own or Progress())
        self._runs.append(run)
        return run

    def schedule(self, run: "RunProgress", phases: Sequence[Phase]) -> None:
        """Add the phases of a run; when all have told theirs, they are announced."""
        run.iterations = {iteration for iteration, _, _ in phases}
        for iteration, name, total in phases:
            self._totals[iteration, PHASES.index(name)] += total

    def phase(self, run: "RunProgress", place: Place, num_iterations: int) -> None:
        """Begin a phase, once the last run has come to it."""
        run.place, run.num_iterations = place, num_iterations
        self._catch_up()

    def advance(self, run: "RunProgress", amount: int, values: Mapping[str, float]) -> None:
        """Count work; that of runs which are ahead is shown later."""
        self._done[run.place] += amount
        run.values.update(values)
        if run.place == self._now:
            self._shown.advance(amount, **self._mean_values(values))

    def iteration_done(self, run: "RunProgress", metrics: Mapping[str, Any]) -> None:
        """Tell what the runs measured, once the last of them has finished the iteration."""
        run.iterations.discard(metrics["iteration"])
        self._finished[metrics["iteration"]].append(metrics)
        self._tell_finished()

    def message(self, text: str) -> None:
        """Say something."""
        self._shown.message(text)

    def leave(self, run: "RunProgress") -> None:
        """Wait no longer for a run."""
        with self.lock:
            self._runs.remove(run)
            self._tell_finished()
            self._catch_up()

    def _catch_up(self) -> None:
        least = min(self._runs, key=lambda run: run.place, default=None)
        if least is None or least.place[0] < 0 or least.place == self._now:
            return
        if not self._announced:
            self._announced = True
            work = sorted(self._totals.items())
            self._shown.schedule([(place[0], PHASES[place[1]], total) for place, total in work])
        self._now = iteration, phase = least.place
        total = self._totals[self._now]
        for run in self._runs:
            run.values.clear()
        self._shown.phase(iteration, least.num_iterations, PHASES[phase], total)
        if self._done[self._now]:
            self._shown.advance(self._done[self._now])

    def _mean_values(self, values: Mapping[str, float]) -> dict[str, float]:
        """The average over the runs of what one of them tells anew."""
        return {
            name: float(np.mean([run.values[name] for run in self._runs if name in run.values]))
            for name in values
        }

    def _tell_finished(self) -> None:
        for iteration in sorted(self._finished):
            if not any(iteration in run.iterations for run in self._runs):
                self._shown.iteration_done(pooled(self._finished.pop(iteration)))


class RunProgress(Progress):
    """What one of several runs tells its progress to; leave it when the run ends."""

    def __init__(
        self,
        shared: SharedProgress,
        seed: int,
        on_phase: Callable[[Place], None],
        own: Progress,
    ):
        self.place: Place = (-1, 0)
        self.num_iterations = 0
        self.iterations: set[int] = set()
        self.values: dict[str, float] = {}
        self._shared, self._seed, self._on_phase, self._own = shared, seed, on_phase, own

    def __exit__(self, kind, error, trace) -> None:
        """Leave."""
        self._shared.leave(self)

    def schedule(self, phases: Sequence[Phase]) -> None:
        """See `Progress.schedule`."""
        with self._shared.lock:
            self._own.schedule(phases)
            self._shared.schedule(self, phases)

    def phase(self, iteration: int, num_iterations: int, name: str, total: int) -> None:
        """See `Progress.phase`."""
        place = iteration, PHASES.index(name)
        with self._shared.lock:
            self._own.phase(iteration, num_iterations, name, total)
            self._shared.phase(self, place, num_iterations)
        self._on_phase(place)

    def advance(self, amount: int = 1, **values: float) -> None:
        """See `Progress.advance`."""
        with self._shared.lock:
            self._own.advance(amount, **values)
            self._shared.advance(self, amount, values)

    def iteration_done(self, metrics: Mapping[str, Any]) -> None:
        """See `Progress.iteration_done`."""
        with self._shared.lock:
            self._own.iteration_done(metrics)
            self._shared.iteration_done(self, metrics)

    def message(self, text: str) -> None:
        """See `Progress.message`; the seed is named."""
        with self._shared.lock:
            self._own.message(text)
            self._shared.message(f"seed {self._seed}: {text}")


def pooled(metrics: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """An iteration's metrics over all episodes of several runs, as far as they are shown."""
    collections = [one["collection"] for one in metrics if "collection" in one]
    groups = metrics[0]["evaluation"]
    return {
        "iteration": metrics[0]["iteration"],
        "timesteps": sum(one["timesteps"] for one in metrics),
        "collection": _pooled_returns(collections) if collections else {},
        "evaluation": {g: _pooled_returns([m["evaluation"][g] for m in metrics]) for g in groups},
    }


def _pooled_returns(parts: Sequence[Mapping[str, Any]]) -> dict[str, float]:
    returns = np.concatenate([part["returns"] for part in parts])
    return {"return_mean": float(returns.mean()), "return_std": float(returns.std())}
