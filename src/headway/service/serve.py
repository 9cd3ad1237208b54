"""A controller behind a WebSocket: observations in, actions out, JSON both ways.

A connection is one robot's session, with a controller of its own. Plans are made in threads, so
that the event loop goes on; a session answers one message after the other.
"""

import asyncio
import contextlib
import hmac
import json
import logging
import signal
import warnings
from collections.abc import Callable, Mapping
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from http import HTTPStatus
from pathlib import Path
from typing import Any

from headway.api import load
from headway.errors import ConfigError, HeadwayError, RunError, needs, one_line, shown
from headway.planning.controller import Controller
from headway.training.run import Iteration

Say = Callable[[str], Any]
LONGEST = 2**16
"""Bytes of a message at most."""
LOOPBACK = ("127.0.0.1", "::1", "localhost")
MESSAGES = ({"obs"}, {"obs", "applied_action"}, {"reset"})
ALLOWED = (
    '{"obs": [numbers, or null where a sensor is silent]}, perhaps with "applied_action";'
    ' {"reset": true} or with sim_params'
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
    ready: Say = print,
    say: Say = print,
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
        ready: Called once with the URL when robots may connect.
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
    needs("serve", "websockets")
    first = load(run_dir, iteration=iteration, settings=settings, deadline_ms=deadline_ms)
    another = partial(Controller, first.agent, deadline_ms=deadline_ms)
    with warnings.catch_warnings(action="ignore"):  # all would say the same
        others = [another(seed=seed) for seed in range(1, max_robots)]
    session = partial(_session, [first, *others], silence_s, say)
    with asyncio.Runner() as runner:
        runner.get_loop().set_default_executor(ThreadPoolExecutor(max_robots))
        runner.run(_listen(session, host, port, partial(_refuse, token), ready))


async def _listen(session: Any, host: str, port: int, refuse: Any, ready: Say) -> None:
    """Wait for robots until Ctrl-C or SIGTERM.

    Raises:
        RunError: The address cannot be listened on.
    """
    from websockets.asyncio.server import serve as listen

    quiet = logging.getLogger("headway.serve")  # strangers' handshakes are no news
    quiet.setLevel(logging.CRITICAL)
    try:
        server = await listen(
            session,
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
        for number in (signal.SIGINT, signal.SIGTERM):
            with contextlib.suppress(RuntimeError):  # not in every thread and system
                asyncio.get_running_loop().add_signal_handler(number, server.close)
        where, port = f"[{host}]" if ":" in host else host, server.sockets[0].getsockname()[1]
        ready(f"ws://{where}:{port}")
        await server.wait_closed()


def _refuse(token: str | None, robot: Any, request: Any) -> Any:
    """Answer a handshake without the token; None lets it go on."""
    given = " ".join(request.headers.get_all("Authorization")).encode(errors="surrogateescape")
    if not token or hmac.compare_digest(given, f"Bearer {token}".encode()):
        return None
    error = {"error": "token missing or wrong, allowed: Authorization: Bearer TOKEN"}
    return robot.respond(HTTPStatus.UNAUTHORIZED, json.dumps(error) + "\n")


async def _session(free: list[Controller], silence_s: float, say: Say, robot: Any) -> None:
    """One robot's, with a controller that is free, from its connection to its end."""
    from websockets.exceptions import ConnectionClosed

    if not free:
        reason = "as many robots are connected as max_robots allows"
        await robot.send(json.dumps({"error": reason}))
        await robot.close(1013, reason)
        return
    name = "{}:{}".format(*robot.remote_address[:2])
    say(f"{name} connected")
    controller, answers, why = free.pop(), 0, "the robot left"
    try:
        await asyncio.to_thread(controller.reset)
        while True:
            message = await asyncio.wait_for(robot.recv(), silence_s)
            answer = await asyncio.to_thread(_answer, controller, message)
            await robot.send(json.dumps(answer))
            answers += 1
    except TimeoutError:
        why = f"no message for {silence_s:g} s"
        await robot.close(1000, why)
    except ConnectionClosed:
        pass
    except Exception as error:
        why = f"{type(error).__name__}: {one_line(error, 300)}"
        raise
    finally:
        free.append(controller)
        say(f"{name} ended after {answers} answers: {why}")


def _answer(controller: Controller, message: str | bytes) -> dict[str, Any]:
    """The answer to a message; what is wrong with one is an answer too."""
    try:
        asked = json.loads(message, parse_int=float)  # Python's integers may be endless
        if not isinstance(asked, dict) or {*asked} not in MESSAGES:
            raise ConfigError(f"the message is {shown(message)}, allowed: {ALLOWED}.")
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
    heads = None if heads is None else heads.tolist()
    return {"action": action.tolist(), **status._asdict(), "heads": heads}
