"""What is promised about the package itself: light imports, one version, tidy files."""

import inspect
import re
import subprocess
import sys
import tomllib
import zipfile
from collections.abc import Iterator
from pathlib import Path

import pytest
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

import headway
from headway import errors

ROOT = Path(__file__).parent.parent
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())
DOCS = [
    ROOT / "README.md",
    *sorted((ROOT / "docs").rglob("*.md")),
    *sorted((ROOT / "results").rglob("README.md")),
]
HEAVY = {"gymnasium", "matplotlib", "mujoco", "ray", "tensorboardX"}
FOLDERS = "benchmarks|docs|examples|results|src|tests"


def run_python(code: str) -> str:
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=True, cwd=ROOT
    )
    return done.stdout


CORE = ["", ".api", ".models.fitting", ".planning.agent", ".worlds.locomotion"]


@pytest.mark.parametrize("module", CORE)
def test_import_is_light(module):
    loaded = set(run_python(f"import headway{module}, sys; print(*sys.modules)").split())
    assert f"headway{module}" in loaded
    assert not HEAVY & loaded


def test_gymnasium_knows_the_environments_once_they_are_imported():
    make = "gymnasium.make('headway/Pendulum-v0').reset()"
    loaded = run_python(f"import gymnasium, headway.envs as e, sys; print(*sys.modules); {make}")
    assert not {"jax", "mujoco"} & set(loaded.split())


def test_version_is_the_one_in_pyproject_and_is_cited():
    assert headway.__version__ == PROJECT["project"]["version"]
    cited = (ROOT / "CITATION.cff").read_text()
    assert re.search(r"^version: (.+)$", cited, re.MULTILINE)[1] == headway.__version__


@pytest.mark.parametrize("name", headway.__all__)
def test_public_name_resolves_and_is_documented(name):
    value = getattr(headway, name)
    if inspect.isclass(value) or inspect.isroutine(value):
        doc = value.__doc__ or ""
        # A dataclass without a docstring gets its signature as one.
        assert doc
        assert not doc.startswith(f"{name}(")


def test_every_error_is_public():
    raised = [name for name, value in vars(errors).items() if inspect.isclass(value)]
    wanted = {name for name in raised if issubclass(getattr(errors, name), headway.HeadwayError)}
    assert "PlanningError" in wanted
    assert wanted <= set(headway.__all__)


def test_wheel_holds_the_package_and_its_type_marker(tmp_path):
    command = [sys.executable, "-m", "hatchling", "build", "-t", "wheel", "-d", str(tmp_path)]
    subprocess.run(command, check=True, capture_output=True, cwd=ROOT)
    (wheel,) = tmp_path.glob("*.whl")
    names = set(zipfile.ZipFile(wheel).namelist())
    package = ROOT / "src"
    files = {path for path in package.rglob("*") if path.is_file() and path.suffix != ".pyc"}
    assert {str(path.relative_to(package)) for path in files} <= names
    assert {name.partition("/")[0] for name in names} == {
        "headway",
        f"headway-{headway.__version__}.dist-info",
    }


def requirements() -> list[Requirement]:
    """Everything that pyproject.toml asks for, the GPU build aside."""
    found = [*PROJECT["project"]["dependencies"], *PROJECT["build-system"]["requires"]]
    for group in PROJECT["dependency-groups"].values():
        found += group
    return [Requirement(text) for text in found]


def pins() -> list[Requirement]:
    lines = (ROOT / "constraints.txt").read_text().splitlines()
    return [Requirement(line) for line in lines if not line.startswith("#")]


@pytest.mark.parametrize("python", ["3.11", "3.12", "3.13"])
def test_constraints_pin_every_requirement_once(python):
    versions = {}
    for pin in pins():
        if pin.marker is None or pin.marker.evaluate({"python_version": python}):
            name = canonicalize_name(pin.name)
            (specifier,) = pin.specifier
            assert (name in versions, specifier.operator, pin.url) == (False, "==", None)
            versions[name] = specifier.version
    for wanted in requirements():
        assert wanted.specifier.contains(versions[canonicalize_name(wanted.name)])


def link_targets(page: Path) -> Iterator[str]:
    """Relative links, and paths of this repository written as code."""
    text = page.read_text()
    prose = re.sub(r"^```.*?^```", "", text, flags=re.DOTALL | re.MULTILINE)
    for target in re.findall(r"\]\(([^)\s]+)[^)]*\)", prose):
        if not re.match(r"[a-z]+:", target):
            yield target
    for target in re.findall(rf"`((?:{FOLDERS})/[\w./-]+)`", prose):
        yield str(ROOT / target)


def anchors(page: Path) -> set[str]:
    """The anchors that a page's headings get."""
    titles = re.findall(r"^#+ +(.*)$", page.read_text(), flags=re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", title.lower()).replace(" ", "-") for title in titles}


@pytest.mark.parametrize("page", DOCS, ids=lambda page: str(page.relative_to(ROOT)))
def test_links_lead_somewhere(page):
    for target in link_targets(page):
        path, _, anchor = target.partition("#")
        file = (page.parent / path) if path else page
        assert file.exists(), f"{page.name} links to {target}, which is not there"
        if anchor:
            assert anchor in anchors(file), f"{page.name} links to {target}: no such heading"
