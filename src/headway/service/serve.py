"""A controller behind a WebSocket: observations in, actions out, JSON both ways.

A connection is one robot's session, with a controller of its own. Plans are made in threads, so
that the event loop goes on; a session answers one message after the other.
"""

import asyncio
import contextlib
import dataclasses
import hmac
import json
import logging
import signal
import warnings
from collections.abc import Callable, Mapping
from concurrent.futures import ThreadPoolExecutor
from http import HTTPStatus
from pathlib import Path
from typing import Any

from headway.errors import ConfigError, HeadwayError, RunError, one_line, shown
from headway.models.compilation import prepare_jax
from headway.planning.controller import Controller
from headway.service import needs
from headway.service.export import describe
from headway.training.methods import config_to_evaluate
from headway.training.run import Iteration, RunDir
from headway.training.trainers import load_agent

Ready = Callable[[dict[str, Any]], Any]
LONGEST = 2**16
"""Bytes of a message at most."""
LOOPBACK = ("127.0.0.1", "::1", "localhost")
MESSAGES = ({"obs"}, {"obs", "applied_action"}, {"reset"}, {"describe"})
ALLOWED = (
    '{"obs": [numbers, or null where a sensor is silent]}, perhaps with "applied_action";'
    ' {"reset": true} or with sim_params; {"describe": true}'
)


def serve(  # noqa: PLR0913 (keywords, all with a default)
    run_dir: str | Path,
    *,
    deadline_ms: float = 100.0,
    host: str = "127.0.0.1",
    port: int = 8765,
    token: str | None = None,
    max_robots: int = 4,
    silence_s: float = 60.0,
    iteration: Iteration = None,
    settings: Mapping[str, Any] | None = None,
    ready: Ready = print,
    say: Callable[[str], Any] = print,
) -> None:
    """Serve the controller of a run until Ctrl-C or SIGTERM; blocks.

    Args:
        run_dir: The run directory.
        deadline_ms: As `Controller`; what the network takes comes on top.
        host: Address to listen on.
        port: Likewise; 0 takes a free one.
        token: What clients must show as `Authorization: Bearer TOKEN`; none on loopback by default.
        max_robots: Sessions at once. Their controllers are made and compiled before the first.
        silence_s: Seconds without a message after which a session is closed.
        iteration: As `load`.
        settings: As `load`.
        ready: Called once with `url` and `description` when robots may connect.
        say: Called with a line when a robot comes or goes.

    Raises:
        ConfigError: A setting is not allowed, a package is missing, or the host is not loopback
            and there is no token.
        RunError: As `load`, or the address cannot be listened on.
    """
    if not (max_robots >= 1 and silence_s > 0 and 0 <= port < 2**16):
        raise ConfigError(
            f"max_robots is {max_robots}, silence_s {silence_s:g} and port {port}, allowed: at"
            " least 1, more than 0, and 0 to 65535."
        )
    if not token and host not in LOOPBACK:
        raise ConfigError(
            f"host {host!r} can be reached from other machines, allowed: with a token, or"
            " 127.0.0.1; set HEADWAY_TOKEN or --token."
        )
    needs("websockets", "serve")
    prepare_jax()
    run = RunDir(run_dir)
    config = config_to_evaluate(run.config(), settings or {}, ("planner",))
    agent = load_agent(run, config, iteration=iteration)
    controllers = [Controller(agent, deadline_ms=deadline_ms)]
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # all would say the same
        for seed in range(1, max_robots):
            controllers.append(Controller(agent, seed=seed, deadline_ms=deadline_ms))
    limits = {"deadline_ms": deadline_ms, "max_robots": max_robots}
    about = describe(run, config, agent) | limits
    with ThreadPoolExecutor(max_robots, thread_name_prefix="headway-robot") as threads:
        sessions = Sessions(controllers, about, threads, silence_s, say)
        asyncio.run(sessions.listen(host, port, token, ready))


@dataclasses.dataclass
class Sessions:
    """The sessions of all robots."""

    free: list[Controller]
    """One for each robot that may still connect."""
    about: Mapping[str, Any]
    """Answer to `{"describe": true}`."""
    threads: ThreadPoolExecutor
    """Where plans are made."""
    silence_s: float
    """Seconds without a message after which a session is closed."""
    say: Callable[[str], Any]
    """Called with a line when a robot comes or goes."""

    async def listen(self, host: str, port: int, token: str | None, ready: Ready) -> None:
        """Wait for robots until Ctrl-C or SIGTERM.

        Raises:
            RunError: The address cannot be listened on.
        """
        from websockets.asyncio.server import serve as listen

        def refuse(robot: Any, request: Any) -> Any:
            """Answer a handshake without the token; None lets it go on."""
            given = " ".join(request.headers.get_all("Authorization")).encode()
            if token and not hmac.compare_digest(given, f"Bearer {token}".encode()):
                error = {"error": "token missing or wrong, allowed: Authorization: Bearer TOKEN"}
                return robot.respond(HTTPStatus.UNAUTHORIZED, json.dumps(error) + "\n")
            return None

        quiet = logging.getLogger("headway.serve")  # strangers' handshakes are no news
        quiet.setLevel(logging.CRITICAL)
        stop, loop = asyncio.Event(), asyncio.get_running_loop()
        for number in (signal.SIGINT, signal.SIGTERM):
            with contextlib.suppress(RuntimeError, ValueError):  # not in every thread and system
                loop.add_signal_handler(number, stop.set)
        try:
            server = await listen(
                self.session,
                host,
                port,
                process_request=refuse,
                origins=[None],  # a page in somebody's browser is no robot
                max_size=LONGEST,
                compression=None,
                close_timeout=1,
                logger=quiet,
            )
        except OSError as error:
            reason = one_line(error.strerror or error)
            raise RunError(f"cannot listen on {host}:{port}: {reason}; choose another.") from None
        async with server:
            where, port = f"[{host}]" if ":" in host else host, server.sockets[0].getsockname()[1]
            ready({"url": f"ws://{where}:{port}", "description": self.about})
            await stop.wait()

    async def session(self, robot: Any) -> None:
        """One robot's, from its connection to its end."""
        from websockets.exceptions import ConnectionClosed

        if not self.free:
            reason = f"{self.about['max_robots']} robots are connected, allowed: no more"
            await robot.send(json.dumps({"error": reason}))
            await robot.close(1013, reason)
            return
        controller, name = self.free.pop(), "{}:{}".format(*robot.remote_address[:2])
        self.say(f"{name} connected")
        loop, answers, why = asyncio.get_running_loop(), 0, "the robot left"
        try:
            await loop.run_in_executor(self.threads, controller.reset)
            while True:
                async with asyncio.timeout(self.silence_s):
                    message = await robot.recv()
                args = answered, controller, message, self.about
                answer = await loop.run_in_executor(self.threads, *args)
                await robot.send(json.dumps(answer))
                answers += 1
        except TimeoutError:
            why = f"no message for {self.silence_s:g} s"
            await robot.close(1000, why)
        except ConnectionClosed:
            pass
        except Exception as error:
            why = f"{type(error).__name__}: {one_line(error, 300)}"
            raise
        finally:
            self.free.append(controller)
            self.say(f"{name} ended after {answers} answers: {why}")


def answered(
    controller: Controller, message: str | bytes, about: Mapping[str, Any]
) -> Mapping[str, Any]:
    """The answer to a message; what is wrong with one is an answer too."""
    try:
        asked = json.loads(message, parse_int=float)  # Python's integers may be endless
        if not isinstance(asked, dict) or {*asked} not in MESSAGES:
            raise ConfigError(f"the message is {shown(message)}, allowed: {ALLOWED}.")
        if "describe" in asked:
            return about
        if "reset" in asked:
            physics = asked["reset"]
            controller.reset(physics if isinstance(physics, dict) else None)
            return {"reset": True}
        action = controller.act(asked["obs"], applied_action=asked.get("applied_action"))
    except (HeadwayError, ValueError, RecursionError) as error:
        what = "" if isinstance(error, HeadwayError) else "the message cannot be read: "
        return {"error": what + one_line(error, 300), "type": type(error).__name__}
    status, heads = controller.status, controller.heads
    assert status is not None
    return {
        "action": action.tolist(),
        **status._asdict(),
        "heads": None if heads is None else heads.tolist(),
    }
