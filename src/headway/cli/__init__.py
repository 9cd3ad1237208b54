"""The command `headway`: parses, calls one library function, prints.

Results go to stdout, progress and errors to stderr. Exit codes: 0 done, 1 an error of
Headway's, 2 wrong usage, 130 interrupted, 143 terminated.
"""

import os
import sys
from collections.abc import Sequence
from typing import NoReturn

from headway import __version__
from headway.cli.usage import UsageError, closest, one_line
from headway.errors import HeadwayError

RESUMABLE = ("train", "reproduce", "sweep")
TERMINATED = 143  # as a shell reports SIGTERM

HELP = """\
usage: headway COMMAND ... [--help]

Control that keeps making headway when the physics changes.

commands:
  train ENV           train a controller on an environment whose physics vary
  evaluate RUN        test a trained run on training and unseen physics
  record RUN          film an episode of a trained run, with the heads that it plans with
  diagnose RUN        measure how well a trained run selects heads
  report RUN ...      compare runs on one HTML page
  reproduce NAME      run what is missing of an experiment of the paper, and draw it
  sweep               run methods, settings, environments and seeds with each other
  list WHAT           list envs, methods, presets or experiments
  plot-dynamics ENV   draw what an action leads to under each physics

options:
  -h, --help          show this text; `headway COMMAND --help` shows a command's options
  --version           print the version

Every command takes --json, which prints one JSON line of results on stdout.
"""


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line.

    Args:
        argv: The arguments; those of the process by default.

    Returns:
        The exit code.
    """
    words = list(sys.argv[1:] if argv is None else argv)
    try:
        code = _dispatch(words)
        sys.stdout.flush()
        return code
    except UsageError as error:
        return _fail(str(error), 2)
    except HeadwayError as error:
        return _fail(str(error), 1)
    except BrokenPipeError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 1
    except OSError as error:
        return _fail(_describe(error), 1)
    except KeyboardInterrupt:
        _say_stopped("interrupted", words)
        return _leave(130) if argv is None else 130
    except SystemExit as stop:
        if stop.code != TERMINATED:
            raise
        _say_stopped("terminated", words)
        return _leave(TERMINATED) if argv is None else TERMINATED


def _dispatch(words: list[str]) -> int:
    if not words:
        raise UsageError("missing command. `headway --help` lists all commands.")
    if words[0] in ("-h", "--help", "help"):
        print(HELP, end="")
        return 0
    if words[0] == "--version":
        print(f"headway {__version__}")
        return 0
    from headway.cli.commands import COMMANDS

    name, *rest = words
    if name not in COMMANDS:
        raise UsageError(
            f"unknown command {name!r}.{closest(name, COMMANDS)} Allowed: {', '.join(COMMANDS)}."
        )
    return COMMANDS[name](rest)


def _describe(error: OSError) -> str:
    if error.filename is None:
        return str(error)
    return f"cannot use {error.filename}: {error.strerror}; check the path and its permissions."


def _say_stopped(how: str, words: list[str]) -> None:
    advice = "; the same command goes on where this one stopped"
    print(f"{how}{advice if words[:1] in ([name] for name in RESUMABLE) else ''}", file=sys.stderr)


def _leave(code: int) -> NoReturn:
    """End the process at once: XLA's threads may still compute, and would crash a slow exit."""
    sys.stdout.flush()
    sys.stderr.flush()
    os._exit(code)


def _fail(text: str, code: int) -> int:
    print(f"error: {one_line(text)}", file=sys.stderr)
    return code
