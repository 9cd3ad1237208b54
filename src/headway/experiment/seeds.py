"""Several seeds of one configuration, trained together: their networks run in one program.

Every seed is a run of its own, with its own directory and its own `Trainer` in its own thread;
the runs meet where networks are fitted and where they plan (`models.meeting`).
"""

import contextlib
import dataclasses
from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor, wait
from pathlib import Path
from typing import NamedTuple

from headway.config import Config
from headway.errors import ConfigError, HeadwayError, SeedsError
from headway.experiment.limits import check_memory, make_room_for_programs
from headway.experiment.loading import learner_of, load_task, need_of
from headway.experiment.methods import check_block
from headway.experiment.progress import Progress
from headway.experiment.resumable import went_back
from headway.experiment.shared_progress import RunProgress, SharedProgress
from headway.experiment.training import Trainer, train_run
from headway.models.meeting import Meeting, Seat
from headway.storage.interrupts import stop_requests
from headway.storage.run_dir import RunDir


class _Job(NamedTuple):
    """A run to be made."""

    config: Config
    run: RunDir
    own: Progress | None


class _Begun(NamedTuple):
    """A run that is about to go on."""

    trainer: Trainer
    progress: RunProgress
    seat: Seat

    def train(self) -> None:
        """Train in this thread until the last iteration, or until something stops the run."""
        with self.seat, self.progress as progress:
            try:
                self.trainer.train()
            except HeadwayError as error:
                progress.message(f"stopped: {error} The other seeds go on.")
                raise


def train_seeds(
    config: Config,
    run_dirs: Mapping[int, str | Path],
    progress: Progress | None = None,
    *,
    of_seed: Mapping[int, Progress] | None = None,
    resume_from_last_good: bool = False,
    ignore_limits: bool = False,
) -> list[RunDir]:
    """Train several seeds together until the last iteration, each from wherever its run stands.

    Each directory gets what `train_run` would have written, within rounding: the products of
    several networks may be summed in another order. So a run that was begun here can be finished
    alone, and the other way round. A run that is ahead waits until the others have come to the
    same place. A run that fails stops with everything saved, and the others go on.

    Runs that learn nothing go one after another.

    Args:
        config: All settings; its own seed does not matter.
        run_dirs: A directory for each seed, new or with the same settings.
        progress: Shows where the run is that is least far; silent by default.
        of_seed: For each seed, what is told of its run alone; silent by default.
        resume_from_last_good: Where a file is damaged, forget the iterations that stand on it.
        ignore_limits: Try what seems too large for the free memory.

    Raises:
        ConfigError: The settings do not fit the environment, or share plans with other processes.
        LimitError: The runs together need more memory than is free.
        RunError: A directory holds something else, is damaged, or in use; no run has begun then.
        SeedsError: Some seeds failed, and the others are finished.
    """
    _check(config, run_dirs)
    jobs = [
        _Job(dataclasses.replace(config, seed=seed), RunDir(path), (of_seed or {}).get(seed))
        for seed, path in run_dirs.items()
    ]
    options = {"resume_from_last_good": resume_from_last_good, "ignore_limits": ignore_limits}
    learns = learner_of(config, load_task(config)).learns
    train = _side_by_side if learns else _one_after_another
    failures = train(jobs, progress or Progress(), options)
    if failures:
        raise _failed(failures, len(jobs))
    return [job.run for job in jobs]


def _check(config: Config, run_dirs: Mapping[int, str | Path]) -> None:
    """Refuse what cannot be trained together.

    Raises:
        ConfigError: It cannot.
    """
    if not run_dirs:
        raise ConfigError("there are no seeds, allowed: one or more.")
    if config.planner.devices != "local":
        raise ConfigError(
            f"planner.devices is {config.planner.devices!r}, allowed with several seeds: 'local';"
            " change it, or train the seeds apart."
        )
    check_block(config)


def _one_after_another(
    jobs: Sequence[_Job], progress: Progress, options: Mapping[str, bool]
) -> dict[int, HeadwayError]:
    """Make runs that have no networks, and thus nothing to compute together."""
    failures = {}
    for config, run, own in jobs:
        progress.message(f"seed {config.seed} by itself, because {config.method} learns nothing")
        try:
            train_run(config, run.path, own or progress, **options)
        except HeadwayError as error:
            failures[config.seed] = error
    return failures


def _side_by_side(
    jobs: Sequence[_Job], progress: Progress, options: Mapping[str, bool]
) -> dict[int, HeadwayError]:
    """Train every run in a thread of its own; return why some failed."""
    make_room_for_programs()
    if not options["ignore_limits"]:
        check_memory(need_of(jobs[0].config).times(len(jobs)), may_ignore=True)
    with progress as shown, contextlib.ExitStack() as held:
        for job in jobs:
            held.enter_context(job.run.locked())
        with stop_requests() as stop:
            meeting, shared, begun = Meeting(), SharedProgress(shown), {}
            for config, run, own in jobs:
                seat = meeting.take_seat()
                told = shared.of_run(config.seed, seat.move, own)
                if options["resume_from_last_good"]:
                    told.message(went_back(run.go_back()))
                trainer = Trainer.open(config, run, told, stop)
                held.enter_context(contextlib.closing(trainer.arena))
                begun[config.seed] = _Begun(trainer, told, seat)
            return _ended(begun, meeting)


def _ended(begun: Mapping[int, _Begun], meeting: Meeting) -> dict[int, HeadwayError]:
    """Let the runs go on until each is over; return why some failed.

    Raises:
        BaseException: What tore one of them out of its work, such as a requested stop.
    """
    with ThreadPoolExecutor(len(begun), thread_name_prefix="headway-seed") as pool, meeting:
        ended = {seed: pool.submit(run.train) for seed, run in begun.items()}
        wait(ended.values())
    failures = {}
    for seed, future in ended.items():
        error = future.exception()
        if isinstance(error, HeadwayError):
            failures[seed] = error
        elif error is not None:
            raise error
    return failures


def _failed(failures: Mapping[int, HeadwayError], num_seeds: int) -> SeedsError:
    """Word the error for seeds that failed."""
    reasons = " ".join(f"seed {seed}: {error}" for seed, error in failures.items())
    others = "" if len(failures) == num_seeds else ", the others are finished"
    return SeedsError(
        f"{len(failures)} of {num_seeds} seeds stopped{others}; the same command goes on with what"
        f" is missing. {reasons}",
        dict(failures),
    )
