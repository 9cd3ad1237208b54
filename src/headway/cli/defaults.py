"""Commands whose defaults come from a configuration: they are parsed twice."""

from collections.abc import Callable, Sequence
from typing import Any

from headway.cli.arguments import AboutRun, WithSettings, changed_settings
from headway.cli.usage import UsageError, parse, wants_help
from headway.config import Config


def parse_for_run(
    plain: AboutRun, words: Sequence[str], prog: str
) -> tuple[AboutRun, dict[str, Any]]:
    """Parse a command about a trained run, whose settings are the defaults.

    Args:
        plain: The command's arguments as they are before anything is known.
        words: What was typed after the command's name.
        prog: The command's name.

    Returns:
        The arguments, and every setting that differs from the run's.
    """

    def trained(first: AboutRun) -> Config:
        from headway.storage.run_dir import RunDir

        return RunDir(first.run).config()

    arguments, _, settings = parse_twice(plain, trained, words, prog)
    return arguments, settings


def parse_twice(
    plain: WithSettings, read: Callable[[WithSettings], Config], words: Sequence[str], prog: str
) -> tuple[WithSettings, Config, dict[str, Any]]:
    """Parse once to learn whose settings are the defaults, and once more with these.

    Args:
        plain: The command's arguments as they are before anything is known.
        read: Finds the configuration that the arguments of the first step name.
        words: What was typed after the command's name.
        prog: The command's name.

    Returns:
        The arguments, the configuration, and every setting that differs from it.
    """
    command = type(plain)
    try:
        first = parse(command, plain, [w for w in words if not wants_help([w])], prog)
    except UsageError:
        if wants_help(words):
            parse(command, plain, ["--help"], prog)
        raise
    config = read(first)
    default = plain.with_defaults(config)
    if wants_help(words):
        parse(command, default, ["--help"], prog)
    arguments = parse(command, default, words, prog)
    return arguments, config, changed_settings(arguments, default)
