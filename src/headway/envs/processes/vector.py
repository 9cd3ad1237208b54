"""Vector environments whose environments run in processes, and can be given up."""

import os
import time
import weakref
from collections.abc import Callable, Sequence
from typing import Any

import gymnasium
from gymnasium.vector import AutoresetMode

from headway.envs.processes.worker import LostWorkerError, Worker
from headway.envs.separate import Calls, SeparateVectorEnv
from headway.errors import BrokenEpisodeError, ConfigError
from headway.sim_params import SimParamSets

CLOSE_TIMEOUT_S = 5.0


class ProcessVectorEnv(SeparateVectorEnv):
    """Any Gymnasium environments, each in a process of its own, stepped side by side.

    An environment that hangs, or whose process dies, costs its episode only: the process is
    killed with all that it started, another one is begun, and `info["broken"]` says so. The
    processes end with this object, and with this process, however that ends.

    Results equal those of `SequentialVectorEnv`, to the bit.

    Args:
        env_fns: Make the environments, in their processes; functions and classes of a script are
            sent there with their code.
        step_timeout_s: Seconds that a reset or step of an environment may take.
        sim_params: Draws the parameters that `reset` is not told; None leaves that to the
            environments, which must then return them in `info["sim_params"]`.
        autoreset_mode: What happens after the end of an episode.
        episode_length: Steps after which an episode is cut; None leaves it to the environments.

    Raises:
        ConfigError: A number is not allowed.
        BadEnvironmentError: An environment could not be made, or their spaces differ.
    """

    def __init__(
        self,
        env_fns: Sequence[Callable[[], gymnasium.Env]],
        *,
        step_timeout_s: float,
        sim_params: SimParamSets | None = None,
        autoreset_mode: AutoresetMode | str = AutoresetMode.NEXT_STEP,
        episode_length: int | None = None,
    ):
        if not step_timeout_s > 0:
            raise ConfigError(f"step_timeout_s is {step_timeout_s}, allowed: more than 0.")
        self._env_fns, self._timeout_s = list(env_fns), step_timeout_s
        self._workers: list[Worker] = []
        self._end = weakref.finalize(self, _kill_all, self._workers, os.getpid())
        self._new: set[int] = set()
        try:
            self._workers += [Worker(make) for make in self._env_fns]
            spaces = [worker.spaces() for worker in self._workers]
            super().__init__(spaces, sim_params, autoreset_mode, episode_length)
        except BaseException:
            self._end()
            raise

    @property
    def pids(self) -> list[int]:
        """Numbers of the processes, each the first of a group."""
        return [worker.pid for worker in self._workers]

    def _call(self, method: str, calls: Calls) -> dict[int, Any]:
        for i in self._new & set(calls):
            self._check_spaces(self._workers[i].spaces())
            self._new.remove(i)
        started = time.monotonic()
        for i, given in calls.items():
            self._workers[i].send(method, given)
        found, unexpected = {}, None
        for i in calls:
            try:
                found[i] = self._workers[i].receive(method, self._timeout_s, started)
            except BrokenEpisodeError as error:
                found[i] = error
                if isinstance(error, LostWorkerError):
                    self._replace(i)
            except Exception as error:  # only once all have answered
                unexpected = error
        if unexpected is not None:
            raise unexpected
        return found

    def _replace(self, i: int) -> None:
        self._workers[i].kill()
        self._workers[i] = Worker(self._env_fns[i])
        self._new.add(i)

    def close_extras(self, **kwargs: Any) -> None:
        """Close the environments, and end their processes."""
        if not self._end.alive:
            return
        started = time.monotonic()
        for worker in self._workers:
            worker.send("close", ())
        for worker in self._workers:
            try:
                worker.receive("close", CLOSE_TIMEOUT_S, started)
            except Exception:  # it ends in any case
                continue
        self._end()


def _kill_all(workers: list[Worker], owner: int) -> None:
    """End the processes, unless this is a fork of the process that began them."""
    if os.getpid() == owner:
        for worker in workers:
            worker.kill()
