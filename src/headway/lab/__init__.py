"""Comparison of runs: tables, figures, one page, films, and the sweeps that make the runs."""

from importlib.util import find_spec

from headway.errors import ConfigError

_missing = [name for name in ("pandas", "scipy", "matplotlib", "jinja2") if not find_spec(name)]
if _missing:
    raise ConfigError(
        f"{', '.join(_missing)} not installed, needed for figures, tables and reports;"
        " pip install headway[lab]."
    )
