"""The training loop: collect, fit, evaluate, save, and again (supplement A.2)."""

import dataclasses
import functools
from contextlib import ExitStack, closing
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np
from jaxtyping import PRNGKeyArray

from headway.config import Config
from headway.data import ReplayBuffer, Trajectory
from headway.errors import BadEnvironmentError, DivergenceError
from headway.experiment.bad_episodes import BadEpisodes
from headway.experiment.divergence import SLOWER, diverged, divergence, first_non_finite
from headway.experiment.evaluation import Tests, episode_rows, evaluate_agent, trajectories_of
from headway.experiment.learners import Fit, Learned, Learner, make_learner
from headway.experiment.limits import check_memory, make_room_for_programs
from headway.experiment.loading import initial, load_learned, need_of
from headway.experiment.resumable import (
    fit_part,
    fitted_before,
    resumable_episodes,
    take_up,
    went_back,
)
from headway.experiment.rollouts import (
    AgentPolicy,
    Arena,
    Episode,
    PlannerUse,
    Policy,
    random_policy,
)
from headway.experiment.tensorboard import write_tensorboard
from headway.models.updates import EpochStats
from headway.planning.acting import Acting
from headway.storage import arrays
from headway.storage.interrupts import StopRequest, stop_requests
from headway.storage.progress_store import ProgressStore
from headway.storage.run_dir import RunDir
from headway.training.progress import Progress


class Keys(NamedTuple):
    """The random streams of one iteration, derived from the seed and the iteration alone."""

    collect: PRNGKeyArray
    fit: PRNGKeyArray
    evaluate: PRNGKeyArray
    diagnose: PRNGKeyArray

    @classmethod
    def of(cls, seed: int, iteration: int) -> "Keys":
        """Independent of how often the run was interrupted before."""
        return cls(*jax.random.split(jax.random.fold_in(jax.random.key(seed), iteration + 1), 4))


@dataclasses.dataclass
class Trainer:
    """A run in progress: what is fixed, what is learned, what was collected."""

    config: Config
    run: RunDir
    arena: Arena
    learner: Learner
    learned: Learned
    buffer: ReplayBuffer
    progress: Progress
    stop: StopRequest
    store: ProgressStore = dataclasses.field(init=False)
    """Keeps what is done of the unfinished iteration."""

    @classmethod
    def open(cls, config: Config, run: RunDir, progress: Progress, stop: StopRequest) -> "Trainer":
        """Begin a run, or go on with the one in the directory, which is locked.

        Raises:
            RunError: The directory holds another run, or a damaged one.
            BadEnvironmentError: The environment does not fit its Task.
        """
        with ExitStack() as unless_open:
            arena = Arena.make(config)
            unless_open.callback(arena.close)
            learner = make_learner(config, arena.task, arena.episode_length)
            run.create_or_resume(config)
            run.check()
            run.tidy()
            buffer = ReplayBuffer(arena.task.obs_size, arena.task.action_size)
            for trajectory in run.load_data() if learner.learns else ():
                buffer.add(trajectory)
            finished = run.finished_iterations
            if finished == 0:
                learned = initial(config, arena.task)
            else:  # the limits were looked at before, or are to be ignored
                learned = load_learned(run, config, ignore_limits=True)
            unless_open.pop_all()
        return cls(config, run, arena, learner, learned, buffer, progress, stop)

    def train(self) -> None:
        """Go through the iterations that are left.

        Raises:
            KeyboardInterrupt: Ctrl-C was pressed; everything is saved.
            Terminated: SIGTERM was sent; everything is saved.
        """
        todo = range(self.run.finished_iterations, self.config.collection.num_iterations)
        for iteration in todo:
            try:
                self.run_iteration(iteration)
            except (BadEnvironmentError, DivergenceError):
                self.store.save()
                raise
            self.stop.answer()
        self.run.partial(self.stop).clear()

    @property
    def agent(self) -> Acting:
        """The agent as learned so far."""
        return self.learner.agent(self.learned, self.arena, self.buffer.trajectories)

    def phase(self, iteration: int, name: str) -> None:
        """Announce what comes next."""
        total = self.amount_of_work(iteration)[name]
        place = f"[{iteration + 1}/{self.config.collection.num_iterations}]"
        self.progress.phase(f"{place} {name}", total)

    def amount_of_work(self, iteration: int) -> dict[str, int]:
        """Environment steps or epochs of each phase of an iteration."""
        length, config = self.arena.episode_length, self.config
        num_tests = len(self.groups(iteration)) * config.evaluation.num_episodes
        learning = {
            "collect": config.collection.num_episodes * length,
            "fit": self.config.fitting.epochs,
        }
        return {**(learning if self.learner.learns else {}), "evaluate": num_tests * length}

    def groups(self, iteration: int) -> list[str]:
        """The groups that are tested after an iteration; often none."""
        evaluation = self.config.evaluation
        last = iteration == self.config.collection.num_iterations - 1
        if not last and (iteration + 1) % evaluation.every:
            return []
        train, *unseen = self.arena.sim_params.group_names
        with_train = last or evaluation.training_group == "always"
        return [train, *unseen] if with_train else unseen

    def run_iteration(self, iteration: int) -> None:
        """Collect, fit, evaluate and save; only the last write makes it count."""
        self.store = self.run.partial(self.stop)
        take_up(self.store, self.progress)
        keys = Keys.of(self.config.seed, iteration)
        learning = self.learn(iteration, keys) if self.learner.learns else {}
        with self.store.timing("evaluate"):
            tests, test_use = self.evaluate(iteration, keys.evaluate)
        metrics = {
            "iteration": iteration,
            "timesteps": self.buffer.num_transitions,
            **learning,
            "evaluation": {
                group: _summary(found) for group, found in trajectories_of(tests).items()
            },
            "test_planner_failures": test_use.failures,
            "seconds": self.store.seconds,
        }
        self.save(iteration, tests, metrics, keys.diagnose)
        self.progress.iteration_done(metrics)

    def learn(self, iteration: int, keys: Keys) -> dict[str, Any]:
        """Collect and fit; return what is measured of both."""
        with self.store.timing("collect"):
            collected, failures = self.collect(iteration, keys.collect)
        with self.store.timing("fit"):
            fitting = self.fit(iteration, keys.fit)
        collection = {**_summary(collected), "planner_failures": failures}
        return {"collection": collection, "fitting": fitting}

    def collect(self, iteration: int, key: PRNGKeyArray) -> tuple[list[Trajectory], int]:
        """Run one episode in each environment, under physics drawn from the training set."""
        config, arena = self.config, self.arena
        rng = np.random.default_rng([config.seed, iteration])
        num_episodes = config.collection.num_episodes
        seeds = rng.integers(2**31 - 1, size=num_episodes)
        episodes = [Episode(arena.sim_params.sample(rng), int(seed)) for seed in seeds]

        def policy() -> Policy:
            if iteration == 0:
                return random_policy(arena, rng)
            return AgentPolicy(self.agent, num_episodes, episodes, key=key)

        self.phase(iteration, "collect")
        advance = self.progress.advance
        rollout = resumable_episodes(self.store, "collect", arena, episodes, policy, advance)
        allowed, say = config.collection.max_bad_episodes, self.progress.message
        bad = BadEpisodes("collection.max_bad_episodes", allowed, say, self.store.drop)
        bad.leave_out("collect", list(rollout.broken.values()))
        bad.want_some(len(rollout.trajectories))
        self.run.save_data(iteration, rollout.trajectories)
        for trajectory in rollout.trajectories:
            self.buffer.add(trajectory)
        return rollout.trajectories, rollout.use.failures

    def fit(self, iteration: int, key: PRNGKeyArray) -> dict[str, Any]:
        """Renew the statistics and go through the data `epochs` times.

        An epoch that diverges is made again from where the last good one ended, with a smaller
        step; the next iteration starts with the usual one.

        Raises:
            DivergenceError: It diverged again and again; what was good is saved.
        """
        self.phase(iteration, "fit")
        state, history, rollbacks = fitted_before(self.store, self.learned.fit)
        self.progress.advance(len(history))
        while True:
            learner = self.learner.slower(SLOWER**rollbacks) if rollbacks else self.learner
            fit = learner.fit(self.buffer.trajectories, iteration, key)
            state, problem = self.fit_epochs(fit, state, history, rollbacks)
            self.learned = Learned(state, fit.statistics)
            if problem is None:
                break
            rollbacks += 1
            self.roll_back(problem, f"epoch {len(history)} of iteration {iteration}", rollbacks)
            self.store.stop_if_asked()
        return {
            "loss": float(history[-1].loss),
            "forward_loss": float(history[-1].forward_loss),
            "updates": sum(int(stats.updates) for stats in history),
            "skipped_updates": sum(int(stats.skipped) for stats in history),
            "rollbacks": rollbacks,
            "transitions": self.buffer.num_transitions,
        }

    def fit_epochs(
        self, fit: Fit, state: Any, history: list[EpochStats], rollbacks: int
    ) -> tuple[Any, str | None]:
        """Run the epochs that are left; stop before one that diverges, and word why."""
        with closing(fit.epochs(state, len(history))) as epochs:
            for fitted, stats in epochs:
                problem = divergence(stats, history)
                if problem is not None:
                    return state, problem
                state = fitted
                self.progress.advance(1, loss=float(stats.loss))
                history.append(stats)
                kept = functools.partial(fit_part, state, list(history), rollbacks)
                self.store.offer("fit", kept)
        return state, None

    def roll_back(self, problem: str, epoch: str, rollbacks: int) -> None:
        """Say that an epoch is made again, or that it is no use.

        Raises:
            DivergenceError: That was once too often.
        """
        if rollbacks <= self.config.fitting.max_rollbacks:
            self.progress.message(f"{epoch}: {problem}; made again with a smaller step.")
            return
        trajectories = self.buffer.trajectories
        where = first_non_finite(trajectories, self.learner.head_losses(self.learned, trajectories))
        raise diverged(epoch, rollbacks, problem, where)

    def evaluate(self, iteration: int, key: PRNGKeyArray) -> tuple[Tests, PlannerUse]:
        """Test on the unseen groups, and on the training physics when the settings say so."""
        groups = self.groups(iteration)
        if not groups:
            return {}, PlannerUse()
        self.phase(iteration, "evaluate")
        return evaluate_agent(
            self.agent,
            self.arena,
            self.config,
            groups,
            key=key,
            progress=self.progress,
            store=self.store,
        )

    def save(
        self,
        iteration: int,
        tests: Tests,
        metrics: dict[str, Any],
        key: PRNGKeyArray,
    ) -> None:
        """Write everything of a finished iteration; the metrics come last."""
        run, config, learner = self.run, self.config, self.learner
        arrays.save_tree(run.checkpoint(iteration), self.learned)
        run.append_evaluation(episode_rows(config, iteration, tests))
        tested = trajectories_of(tests)
        run.save_tests(iteration, tested)
        shares = learner.head_shares(self.learned, self.buffer.trajectories)
        run.append_assignments([{"iteration": iteration, **row} for row in shares])
        errors = [
            {"iteration": iteration, "group": group, "step": step + 1, "error": float(error)}
            for group, found in tested.items()
            for step, error in enumerate(learner.prediction_error(self.learned, found, key))
        ]
        run.append_prediction_errors(errors)
        run.append_metrics([metrics])
        write_tensorboard(run.path, metrics)
        run.finish(iteration)
        self.store.clear()


def train_run(
    config: Config,
    run_dir: str | Path,
    progress: Progress | None = None,
    *,
    resume_from_last_good: bool = False,
    ignore_limits: bool = False,
) -> RunDir:
    """Train until the last iteration, from wherever the run stands.

    Ctrl-C and SIGTERM save what is done and stop. Only one process trains in a directory.

    Args:
        config: All settings.
        run_dir: A new directory, or one with the same settings.
        progress: Shown while training; silent by default.
        resume_from_last_good: Where a file is damaged, forget the iterations that stand on it.
        ignore_limits: Try what seems too large for the free memory.

    Raises:
        ConfigError: The settings do not fit the environment.
        LimitError: The run needs more memory than is free.
        RunError: The directory holds something else, is damaged, or in use.
    """
    run = RunDir(run_dir)
    make_room_for_programs()
    if not ignore_limits:
        check_memory(need_of(config), may_ignore=True)
    # A display begins once it is certain that the run does.
    with run.locked(), progress or Progress() as shown, stop_requests() as stop:
        if resume_from_last_good:
            shown.message(went_back(run.go_back()))
        trainer = Trainer.open(config, run, shown, stop)
        with closing(trainer.arena):
            trainer.train()
    return run


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
