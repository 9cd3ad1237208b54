"""The training loop: collect, fit, evaluate, save, and again (supplement A.2)."""

import dataclasses
import time
import warnings
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import closing, nullcontext
from functools import partial
from pathlib import Path
from typing import Any, Literal

import jax
import numpy as np
from jaxtyping import PRNGKeyArray

from headway.config import Config, override
from headway.data import Trajectory
from headway.errors import ConfigError, DivergenceError
from headway.models.fitting import EpochStats
from headway.task import BUILT_IN, episode_length
from headway.training.check import compared, refuse_faults
from headway.training.collect import Batches, Episode, Rollout, agent_policy, random_policy
from headway.training.environments import Environments
from headway.training.evaluate import Tests, iteration_keys, run_tests
from headway.training.files import new_folder, tree_arrays, tree_from_arrays, write_bytes
from headway.training.progress import Progress
from headway.training.recordings import HELD_OUT, Log
from headway.training.run import RunDir
from headway.training.stopping import StopRequest, stop_requests
from headway.training.trainers import make_trainer

SAVE_EVERY = 30.0  # seconds between two writes of an unfinished fit
MAX_SKIPPED = 0.5
"""Share of an epoch's updates that may be skipped because their loss or gradient is not finite."""
EXPLODED = 100.0
"""A loss has exploded when it is above the iteration's best by this many times its size, or 1."""
SLOWER = 0.25
"""Factor on the step size with every roll-back."""
FEW_BATCHES = 4
"""With fewer in all of its data a run is told that they are too few."""
MANY_MAPS = 30_000
"""Half of the memory maps that Linux allows a process."""


OnIteration = Callable[[dict[str, Any]], Any]
"""Called with the line of `metrics.jsonl` of each iteration, once that counts."""


def train_run(
    config: Config,
    run_dir: str | Path,
    progress: Progress | None = None,
    on_iteration: OnIteration | None = None,
    *,
    resume_from_last_good: bool = False,
    log: Log | None = None,
) -> RunDir:
    """Train until the last iteration, from wherever the run stands.

    Ctrl-C and SIGTERM stop after a step or an epoch; what is finished is saved. Only one process
    trains in a directory.

    Args:
        config: All settings.
        run_dir: A new directory, or one with the same settings and as many iterations at most.
        progress: Shown while training; silent by default.
        on_iteration: Called after each iteration; what it raises ends the run.
        resume_from_last_good: Where a file is damaged, forget the iterations that stand on it.
        log: Recordings to fit in every iteration, whose settings are `config`; no environment is
            made, nothing is collected or tested.

    Raises:
        ConfigError: The settings do not fit the environment.
        RunError: The directory holds something else, is damaged, or in use.
        LimitError: The disk is full; nothing is lost.
        BadEnvironmentError: The environment broke its contract; what is finished is saved.
        DivergenceError: Fitting diverged again and again.
        KeyboardInterrupt: Ctrl-C was pressed.
        Terminated: SIGTERM was sent.
    """
    run = RunDir(run_dir)
    _forget_programs()
    if config.collection.check and config.env not in BUILT_IN:
        run.refuse_changed()
        if log is None:
            refuse_faults(config)
    # A display begins once it is certain that the run does.
    with run.locked(), progress or Progress() as shown, stop_requests() as stop:
        if resume_from_last_good:
            good = run.go_back()
            intact = f"goes on after iteration {good}, which is intact"
            shown.message("begins anew" if good is None else intact)
        with nullcontext() if log else closing(Environments.make(config)) as environments:
            if environments:
                config = dataclasses.replace(config, spaces=environments.task.spaces)
            run.begin(config)
            for remark in log.remarks if log else ():
                shown.message(remark)
            if config.model.learned_reward:
                shown.message("reward and end of episodes are learned, not the Task's")
            _Training(config, run, environments, shown, stop, on_iteration, log).train()
    return run


def continued(run_dir: str | Path, settings: Mapping[str, Any] | None = None) -> Config:
    """The settings of a finished run that goes on, by default for as many iterations again.

    Raises:
        RunError: There is no run, or it is not finished.
        ConfigError: Settings would make it another run, or no longer.
    """
    run = RunDir(run_dir)
    begun = run.finished_config().collection.num_iterations
    twice = {"collection.num_iterations": 2 * begun}
    config = override(run.config(), {**twice, **(settings or {})})
    wanted = config.collection.num_iterations
    if (changed := run.changes(config)) or wanted <= begun:
        raise ConfigError(
            f"collection.num_iterations is {wanted} and changed is"
            f" {'; '.join(changed) or 'nothing'}, allowed: more iterations than {begun}, and the"
            f" settings of {run_dir}."
        )
    return config


def copy_run(run_dir: Path, to: Path) -> None:
    """Copy a run's newest iteration, to go on with it; what there is already is kept."""
    if not to.exists():
        files = RunDir(run_dir).files(data=True)
        with new_folder(to) as folder:
            for name, content in files.items():
                write_bytes(folder / name, content)


@dataclasses.dataclass
class _Training:
    """A run in progress."""

    config: Config
    run: RunDir
    """The directory, which is locked."""
    environments: Environments | None
    progress: Progress
    stop: StopRequest
    on_iteration: OnIteration | None
    log: Log | None = None

    def __post_init__(self):
        learns, begun = self.config.model.learns, self.run.finished_iterations > 0
        self.trainer = make_trainer(self.config, self.environments)
        self.data = self.run.load_data() if learns else []
        self.state = self.trainer.load(self.run) if begun else self.trainer.begin()

    def train(self) -> None:
        """Go through the iterations that are left; only the last write makes one count."""
        config, run, trainer = self.config, self.run, self.trainer
        for iteration in range(run.finished_iterations, config.collection.num_iterations):
            self.iteration, self.partial = iteration, run.partial()
            collect_key, fit_key, test_key, error_key = iteration_keys(config, iteration)
            metrics: dict[str, Any] = {"iteration": iteration}
            collected: list[Trajectory] = []
            seconds = {}
            if self.log and not iteration:
                collected, metrics["recordings"] = self.log.fitted, self.log.recordings
            elif self.environments and config.model.learns:
                rounds = self.collect(collect_key)
                collected = [one for rollout in rounds for one in rollout.episodes.values()]
                seconds["collect"] = sum(rollout.seconds for rollout in rounds)
                failures = {"planner_failures": sum(rollout.use.failures for rollout in rounds)}
                metrics["collection"] = _summary(collected) | failures
            self.data += collected
            if config.model.learns:
                metrics["fitting"], seconds["fit"] = self.fit(fit_key)
            tests = self.evaluate(test_key)
            seconds["evaluate"] = tests.seconds
            tested = tests.trajectories
            metrics |= {
                "timesteps": sum(map(len, self.data)),
                "evaluation": {group: _summary(found) for group, found in tested.items()},
                "test_planner_failures": tests.use.failures,
                "seconds": {name: round(value, 3) for name, value in seconds.items()},
            }
            if self.log and self.log.held_out:
                tested = {HELD_OUT: self.log.held_out}
            errors = {
                group: trainer.prediction_error(self.state, found, error_key)
                for group, found in tested.items()
            }
            if self.log:
                # JSON knows no infinity; a fit whose imagination explodes is to be saved as well.
                held_out, huge = errors.get(HELD_OUT, ()), float(np.finfo(np.float32).max)
                metrics["held_out_error"] = np.nan_to_num(held_out, nan=huge, posinf=huge).tolist()
            shares = trainer.head_shares(self.state, self.data)
            tables = {
                "evaluation.csv": [row.to_csv() for row in tests.rows(config, iteration)],
                "assignments.csv": [{"iteration": iteration, **row} for row in shares],
                "prediction_error.csv": [
                    {"iteration": iteration, "group": group, "step": step, "error": float(error)}
                    for group, found in errors.items()
                    for step, error in enumerate(found, start=1)
                ],
            }
            run.save_iteration(metrics, self.state, collected, tested, tables)
            self.partial.remove()
            self.progress.iteration_done(metrics)
            if self.on_iteration:
                self.on_iteration(metrics)
            self.stop.answer()
        run.partial().remove()

    def groups(self) -> list[str]:
        """The groups that are tested after this iteration; often none."""
        evaluation, number = self.config.evaluation, self.iteration + 1
        last = number == self.config.collection.num_iterations
        if self.environments is None or (not last and number % evaluation.every):
            return []
        train, *unseen = self.environments.sim_params.group_names
        with_train = last or evaluation.training_group == "always"
        return [train, *unseen] if with_train else unseen

    def begin_phase(self, name: str, work: int) -> None:
        """Announce what comes next, and its environment steps or epochs."""
        place = f"[{self.iteration + 1}/{self.config.collection.num_iterations}]"
        self.progress.phase(f"{place} {name}", work)

    def on_step(self, steps: int) -> None:
        """Count environment steps; stop between two of them."""
        self.progress.advance(steps)
        self.stop.answer()

    def collect(self, key: PRNGKeyArray) -> list[Rollout]:
        """Run rounds of one episode in each environment, until there are `min_steps`.

        Physics come from the training set; those of an environment of your own are dealt evenly.
        """
        environments, collection = self.environments, self.config.collection
        assert environments is not None
        own, sets = self.config.env not in BUILT_IN, environments.sim_params
        count, agent = collection.num_episodes, None
        batches, rounds, steps = self.batches("collection"), [], 0
        self.begin_phase("collect", max(count * environments.episode_length, collection.min_steps))
        while not rounds or steps < collection.min_steps:
            number = (len(rounds),) if rounds else ()  # the first one is all of the paper's
            rng = np.random.default_rng([self.config.seed, self.iteration, *number])
            seeds = rng.integers(2**31 - 1, size=count)
            physics = sets.deal(rng, count) if own else [sets.sample(rng) for _ in seeds]
            episodes = [Episode(*one) for one in zip(physics, map(int, seeds), strict=True)]
            if self.iteration > 0:
                agent = agent or self.trainer.agent(self.state, self.data)
                round_key = jax.random.fold_in(key, *number) if number else key
                policy = partial(agent_policy, agent, count, episodes, key=round_key)
            else:
                policy = partial(random_policy, environments, rng)
            rollout = batches.run("-".join(["collect", *map(str, number)]), episodes, policy)
            rounds.append(rollout)
            steps += sum(map(len, rollout.episodes.values()))
        taken = [one for rollout in rounds for one in rollout.episodes.values()]
        if not taken:
            raise batches.too_many()
        if collection.check and own:
            for found in compared(environments.task, taken):
                if found.text:  # random actions did not come where it shows
                    where = f"{self.config.env}, iteration {self.iteration}, {found.name}: "
                    warnings.warn(where + found.text, stacklevel=1)
        return rounds

    def batches(self, phase: Literal["collection", "evaluation"]) -> Batches:
        """Run the episodes of a phase."""
        assert self.environments is not None
        say = self.progress.message
        return Batches(self.environments, self.config, phase, self.on_step, say, self.partial)

    def fit(self, key: PRNGKeyArray) -> tuple[dict[str, Any], float]:
        """Renew the statistics and go through the data `num_epochs` times.

        An epoch that diverges is made again from where the last good one ended, with a smaller
        step; the next iteration starts with the usual one.

        Returns:
            What is measured, and the seconds that it took, those of earlier attempts included.

        Raises:
            DivergenceError: It diverged again and again.
        """
        epochs = self.trainer.num_epochs(self.data)
        self.begin_phase("fit", epochs)
        iteration, partial, rollbacks, seconds = self.iteration, self.partial, 0, 0.0
        history: list[EpochStats] = []
        kept = partial.load("fit")
        if kept is not None:
            arrays, facts = kept
            self.state = tree_from_arrays(self.state, arrays, partial.path("fit"))
            history = [EpochStats(*row) for row in facts["history"]]
            rollbacks, seconds = facts["rollbacks"], facts["seconds"]
            self.progress.advance(len(history))
        started = saved = time.perf_counter()

        def save() -> None:
            rows = [[x.item() for x in map(np.asarray, epoch)] for epoch in history]
            facts = {"history": rows, "rollbacks": rollbacks}
            facts["seconds"] = seconds + time.perf_counter() - started
            partial.save("fit", tree_arrays(self.state), facts)

        while len(history) < epochs:
            rate = max(1e-12, SLOWER**rollbacks * self.config.fitting.learning_rate)
            trainer = make_trainer(override(self.config, {"fitting.learning_rate": rate}))
            problem = None
            for state, stats in trainer.fit(self.state, self.data, iteration, key, len(history)):
                problem = divergence(stats, history)
                if problem is not None:
                    break
                self.state = state
                history.append(stats)
                self.progress.advance(1, loss=float(stats.loss))
                if self.stop or time.perf_counter() - saved >= SAVE_EVERY:
                    save()
                    saved = time.perf_counter()
                self.stop.answer()
            if problem is None:
                break
            rollbacks += 1
            epoch = f"epoch {len(history)} of iteration {iteration}"
            if rollbacks > self.config.fitting.max_rollbacks:
                losses = trainer.head_losses(self.state, self.data)
                raise DivergenceError(
                    f"{epoch} diverged {rollbacks} times: {problem}"
                    f" ({first_non_finite(self.data, losses)}), allowed:"
                    f" fitting.max_rollbacks ({rollbacks - 1}); try a smaller"
                    " fitting.learning_rate in another directory."
                )
            self.progress.message(f"{epoch}: {problem}; made again with a smaller step.")
        save()
        measured = {
            "loss": float(history[-1].loss),
            "forward_loss": float(history[-1].forward_loss),
            "updates": sum(int(stats.updates) for stats in history),
            "skipped_updates": sum(int(stats.skipped) for stats in history),
            "rollbacks": rollbacks,
            "transitions": sum(map(len, self.data)),
        }
        batches, steps = self.trainer.num_batches(self.data), measured["transitions"]
        full = len(self.data) * episode_length(self.config)
        if not self.log and batches < FEW_BATCHES and 2 * steps < full:
            warnings.warn(
                f"{self.config.env}, iteration {iteration}: {steps} transitions make {batches}"
                f" batches (fitting.batch_size {self.config.fitting.batch_size}), too few to learn"
                " from, because episodes end early; raise collection.min_steps, the steps per"
                " iteration.",
                stacklevel=1,
            )
        return measured, seconds + time.perf_counter() - started

    def evaluate(self, key: PRNGKeyArray) -> Tests:
        """Test on the unseen groups, and on the training physics when the settings say so."""
        groups = self.groups()
        if not groups:
            return Tests()
        agent = self.trainer.agent(self.state, self.data)
        begin = partial(self.begin_phase, "evaluate")
        return run_tests(agent, groups, groups, self.batches("evaluation"), key, begin)


def divergence(stats: EpochStats, before: Sequence[EpochStats]) -> str | None:
    """Word what is wrong with an epoch, if anything is.

    Args:
        stats: Of the epoch.
        before: Of the good epochs before it in the same iteration.
    """
    skipped, updates, loss = int(stats.skipped), int(stats.updates), float(stats.loss)
    if skipped > MAX_SKIPPED * updates:
        return f"{skipped} of {updates} updates had no finite loss and gradient"
    best = min((float(epoch.loss) for epoch in before), default=loss)
    if not np.isfinite(loss) or loss - best > EXPLODED * max(1.0, abs(best)):
        return f"the loss rose from {best:.3g} to {loss:.3g}"
    return None


def first_non_finite(trajectories: Sequence[Trajectory], losses: Iterable[np.ndarray]) -> str:
    """Name the first member, head and physics whose loss is not finite; or say there is none.

    Args:
        trajectories: What was fitted.
        losses: Of each of them, [member, head, time].
    """
    for trajectory, loss in zip(trajectories, losses, strict=False):
        bad = np.argwhere(~np.isfinite(loss))
        if len(bad):
            member, head, time = bad[0]
            physics = dict(trajectory.sim_params)
            return f"member {member}, head {head}, at step {time} under sim_params {physics}"
    return "every member and head has a finite loss before the epoch"


def _summary(trajectories: list[Trajectory]) -> dict[str, Any]:
    returns = np.array([trajectory.returns for trajectory in trajectories])
    return {
        "returns": returns.tolist(),
        "return_mean": float(returns.mean()),
        "return_std": float(returns.std()),
        "return_min": float(returns.min()),
        "return_max": float(returns.max()),
        "episodes": len(returns),
    }


def _forget_programs() -> None:
    """Forget compiled programs before a process comes near to its limit of memory maps.

    JAX keeps what it compiled for ever, which is about a thousand maps for a run, and crashes
    beyond what Linux allows (65,530 by default). What is needed again is compiled again, or read
    from the persistent cache.
    """
    maps = Path("/proc/self/maps")
    if maps.exists() and len(maps.read_bytes().splitlines()) > MANY_MAPS:
        jax.clear_caches()
