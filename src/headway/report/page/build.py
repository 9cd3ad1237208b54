"""Putting the page together."""

import base64
import dataclasses
import hashlib
import shlex
from collections.abc import Callable, Sequence
from importlib import resources
from pathlib import Path

import jinja2
from markupsafe import Markup

import headway
from headway.errors import ConfigError, unknown_name
from headway.report.page import facts, insides, sections
from headway.report.page.parts import Section
from headway.report.page.runs import load_runs
from headway.report.page.series import Comparison
from headway.report.page.svg import THEME
from headway.report.page.symbols import same_symbol, symbol
from headway.training.run import write_bytes

SECTIONS: dict[str, Callable[[Comparison], Section]] = {
    "results": sections.results,
    "learning-curves": sections.learning,
    "groups": sections.group_bars,
    "improvement": sections.improvements,
    "head-shares": insides.head_shares,
    "contexts": insides.context_maps,
    "prediction-error": insides.prediction_errors,
    "settings": facts.settings,
    "times": facts.times,
    "runs": facts.sources,
    "numbers": facts.numbers,
}

NAMED = 4  # methods in the title


def write_report(
    runs: Sequence[str | Path], out: str | Path = "report.html", *, only: Sequence[str] = ()
) -> Path:
    """Compare runs on one page that needs nothing else: no network, no other file.

    Runs are grouped by environment, method and seed; variants of a method are told apart by the
    settings in which they differ. What is unfinished or damaged is named on the page.

    Args:
        runs: Run directories, or folders that hold some at any depth.
        out: The HTML file to write.
        only: Chapters to make, by name; all of them by default.

    Returns:
        The file written.

    Raises:
        RunError: A path is no directory, or holds no run that can be read.
        ConfigError: No run is named.
        UnknownNameError: No such chapter.
    """
    if not runs:
        raise ConfigError("no run is given, allowed: one or more run directories.")
    for name in only:
        if name not in SECTIONS:
            raise unknown_name("chapter", name, SECTIONS)
    comparison = Comparison.of(*load_runs(runs))
    names = [name for name in SECTIONS if name in only or not only]
    words = ["headway", "report", *map(str, runs), "-o", str(out)]
    made = [_section(name, comparison, words) for name in names]
    page = render(comparison, made, shlex.join([*words, *(["--only", *only] if only else [])]))
    write_bytes(Path(out), page.encode())
    return Path(out)


def _section(name: str, comparison: Comparison, words: Sequence[str]) -> Section:
    command = shlex.join([*words, "--only", name])
    return dataclasses.replace(SECTIONS[name](comparison), command=command)


def render(comparison: Comparison, made: Sequence[Section], command: str) -> str:
    """The page as text; everything that comes from a run is escaped."""
    environment = jinja2.Environment(
        loader=jinja2.FunctionLoader(_resource),
        autoescape=True,
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    script = _resource("page.js")
    digest = base64.b64encode(hashlib.sha256(script.encode()).digest()).decode()
    return environment.get_template("page.html.jinja").render(
        title=_title([series.label for series in comparison.series]),
        sections=made,
        comparison=comparison,
        symbols={one.index: Markup(symbol(one)) for one in comparison.series},
        same_symbols={one.index: Markup(same_symbol(one)) for one in comparison.series},
        command=command,
        version=headway.__version__,
        style=Markup(_theme() + _resource("page.css") + _switches(comparison)),
        script=Markup(script),
        script_digest=digest,
        svg=Markup,
    )


def _title(labels: Sequence[str]) -> str:
    if len(labels) > NAMED:
        return f"{len(labels)} methods compared"
    return " and ".join(filter(None, [", ".join(labels[:-1]), labels[-1]]))


def _theme() -> str:
    light, dark = (
        "".join(f"--{name}:{pair[mode]};" for name, pair in THEME.items()) for mode in (0, 1)
    )
    return f":root{{{light}}}@media(prefers-color-scheme:dark){{:root{{{dark}}}}}\n"


def _switches(comparison: Comparison) -> str:
    """Rules that hide a series everywhere once its box in the legend is empty."""
    return "".join(
        f"body:has(#show-{one.index}:not(:checked)) .series-{one.index}{{display:none}}\n"
        for one in comparison.series
    )


def _resource(name: str) -> str:
    return resources.files("headway.report.page").joinpath(name).read_text(encoding="utf-8")
