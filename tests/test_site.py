"""The site of `make docs`: nothing that it should have is forgotten; Sphinx checks the links."""

import dataclasses
import re
from pathlib import Path

import headway
import headway.envs
from headway.cli import COMMANDS

ROOT = Path(__file__).parent.parent
SITE = ROOT / "docs/site"
NAVIGATION = (SITE / "navigation.txt").read_text().split()
REFERENCE = "".join(path.read_text() for path in (SITE / "reference").glob("*.rst"))


def documented(directive: str) -> set[str]:
    """What the reference has with such a directive."""
    return set(re.findall(rf"^\.\. {directive}:: (\S+)$", REFERENCE, re.MULTILINE))


def test_every_page_is_in_the_navigation():
    pages = {
        *(ROOT / "docs").glob("*.md"),
        *(SITE / "reference").glob("*.rst"),
        ROOT / "CHANGELOG.md",
    }
    names = {path.relative_to(ROOT).with_suffix("").as_posix() for path in pages}
    assert len(names) > 20
    assert names - set(NAVIGATION) == set()


def test_every_public_name_is_in_the_reference():
    names = {f"headway.{name}" for name in headway.__all__ if name != "__version__"}
    names |= {f"headway.envs.{name}" for name in headway.envs.__all__}
    assert names - documented("(?:auto|py:)[a-z]+") == set()


def test_every_setting_is_in_the_reference():
    fields = {field.name for field in dataclasses.fields(headway.Config)}
    sections = {
        name for name in fields if dataclasses.is_dataclass(getattr(headway.Config("x"), name))
    }
    assert documented("settings") == sections


def test_every_command_is_in_the_reference():
    assert documented("command") == set(COMMANDS)
