"""What is shown of several runs: where the last of them is, with the work of all."""

from headway.experiment.progress import Progress
from headway.experiment.shared_progress import SharedProgress


class Shown(Progress):
    def __init__(self):
        self.said = []

    def schedule(self, phases):
        self.said.append(("schedule", *phases))

    def phase(self, iteration, num_iterations, name, total):
        self.said.append((iteration, name, total))

    def advance(self, amount=1, **values):
        self.said.append((amount, values) if values else amount)

    def iteration_done(self, metrics):
        self.said.append(("done", metrics["iteration"], metrics["collection"]["return_mean"]))

    def message(self, text):
        self.said.append(text)


PHASES = [(0, "collect", 4), (0, "fit", 2)]


def two_runs():
    shown, places = Shown(), []
    shared = SharedProgress(shown)
    runs = [shared.of_run(seed, lambda place, s=seed: places.append((s, place))) for seed in (3, 5)]
    return shown.said, places, runs


def metrics(iteration, *returns):
    summary = {"returns": list(returns)}
    return {"iteration": iteration, "timesteps": 8, "collection": summary, "evaluation": {}}


def test_a_phase_begins_with_the_last_run_and_counts_what_was_done():
    said, places, (a, b) = two_runs()
    a.schedule(PHASES)
    a.phase(0, 1, "collect", 4)
    assert said == []
    b.schedule(PHASES)
    b.phase(0, 1, "collect", 4)
    assert said == [("schedule", (0, "collect", 8), (0, "fit", 4)), (0, "collect", 8)]
    a.advance(4)
    a.phase(0, 1, "fit", 2)
    a.advance(1, loss=1.0)  # not yet: the other one still collects
    b.advance(4)
    assert said[2:] == [4, 4]
    b.phase(0, 1, "fit", 2)
    b.advance(1, loss=3.0)
    a.advance(1, loss=2.0)
    assert said[4:] == [(0, "fit", 4), 1, (1, {"loss": 3.0}), (1, {"loss": 2.5})]
    assert places == [(3, (0, 0)), (5, (0, 0)), (3, (0, 1)), (5, (0, 1))]


def test_an_iteration_is_told_over_all_runs_that_are_left():
    said, _, (a, b) = two_runs()
    for run in (a, b):
        run.schedule([*PHASES, (1, "collect", 4), (1, "fit", 2)])
    a.iteration_done(metrics(0, 1.0, 2.0))
    assert said == []
    b.iteration_done(metrics(0, 6.0))
    assert said == [("done", 0, 3.0)]
    a.iteration_done(metrics(1, 7.0))
    b.message("stopped")
    with b:
        pass
    assert said[1:] == ["seed 5: stopped", ("done", 1, 7.0)]


def test_a_run_that_is_ahead_tells_nothing_of_what_it_has_done():
    said, _, (a, b) = two_runs()
    a.schedule(PHASES)
    b.schedule([])
    a.phase(0, 1, "collect", 4)
    with b:  # it was finished before
        pass
    assert said == [("schedule", *PHASES), (0, "collect", 4)]
