"""A trained controller leaves the house: exported, served, shared."""

from importlib.util import find_spec

from headway.errors import ConfigError


def needs(package: str, extra: str) -> None:
    """Make sure that a package is installed, before anything is begun.

    Raises:
        ConfigError: It is not.
    """
    if not find_spec(package):
        raise ConfigError(f"{package} is not installed; pip install 'headway[{extra}]'.")
