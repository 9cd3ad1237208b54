"""One environment and what is asked of it; also the program of a worker process.

As a program it imports nothing of Headway, so that a process begins at once and knows only the
simulator that it was made for. The first argument is its end of a socket. Everything that comes
through it is from the process that started this one.
"""

import contextlib
import os
import select
import signal
import sys
import traceback
from multiprocessing.connection import Connection
from typing import Any


class Service:
    """An environment as Headway's vector environments use it.

    Args:
        env: A Gymnasium environment.
    """

    def __init__(self, env: Any):
        self._env = env

    def spaces(self) -> tuple[Any, Any]:
        """The spaces of observations and actions as they are now."""
        return self._env.observation_space, self._env.action_space

    def reset(self, seed: int | None, options: dict[str, Any] | None) -> tuple[Any, ...]:
        """Begin an episode; return observation, simulator parameters, and both spaces."""
        obs, info = self._env.reset(seed=seed, options=options)
        return obs, info.get("sim_params", {}), *self.spaces()

    def step(self, action: Any) -> tuple[Any, Any, Any, Any]:
        """Make a step; return observation, reward, whether it ended, whether it was cut."""
        obs, reward, terminated, truncated, _ = self._env.step(action)
        return obs, reward, terminated, truncated

    def change(self, values: dict[str, float]) -> bool:
        """Change the physics during an episode; return whether the environment can."""
        change = getattr(self._env.unwrapped, "set_sim_params", None)
        if change is not None:
            change(values)
        return change is not None

    def close(self) -> None:
        """Free what it holds."""
        self._env.close()


def main() -> None:
    """Make the environment that is sent, and answer until the other end is gone."""
    connection = Connection(int(sys.argv[1]))
    for number in (signal.SIGINT, signal.SIGTERM):  # schedulers send them to every process
        signal.signal(number, lambda *_: None)
    stay_with(connection.fileno())
    sys.path[:] = connection.recv()
    made = answer(lambda: Service(connection.recv()()))
    service: Any = made[1]
    connection.send((0, *(answer(service.spaces) if made[0] == "returned" else made)))
    with contextlib.suppress(EOFError, ConnectionError):
        while True:
            call, method, given = connection.recv()
            connection.send((call, *answer(getattr(service, method), *given)))


def answer(call: Any, *given: Any) -> tuple[Any, ...]:
    """What a call returned; or the classes, text and traceback of what it raised."""
    try:
        return "returned", call(*given)
    except Exception as error:
        kinds = [f"{kind.__module__}.{kind.__qualname__}" for kind in type(error).__mro__]
        return "raised", kinds, str(error), traceback.format_exc()


def stay_with(socket: int) -> None:
    """Make sure that this process ends when the other end of the socket is gone.

    The process forks. Its child returns and does the work; it may hang in a simulator, where no
    code of ours runs any more. What was there before stays behind, and kills the whole process
    group, the simulator's own processes too, once nobody is at the other end.
    """
    child = os.fork()
    if child == 0:
        return
    woken, wake = os.pipe()
    os.set_blocking(wake, False)
    signal.set_wakeup_fd(wake)
    signal.signal(signal.SIGCHLD, lambda *_: None)
    poll = select.poll()
    poll.register(socket, 0)  # only its end
    poll.register(woken, select.POLLIN)
    while True:
        ended, status = os.waitpid(child, os.WNOHANG)
        if ended:
            code = os.waitstatus_to_exitcode(status)
            os._exit(code if code >= 0 else 128 - code)
        ready = [number for number, _ in poll.poll()]
        if socket in ready:
            os.killpg(0, signal.SIGKILL)
        os.read(woken, 64)


if __name__ == "__main__":
    main()
