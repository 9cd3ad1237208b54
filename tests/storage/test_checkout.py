"""The commit of a checkout, as Git lays it out on disk."""

import json
import shutil
import subprocess
from pathlib import Path

import pytest

from headway.experiment.methods import make_config
from headway.storage import checkout
from headway.storage.run_dir import RunDir


def git(root: Path, *words: str) -> str:
    options = ["-c", "user.name=N", "-c", "user.email=n@example.org", "-c", "commit.gpgsign=false"]
    done = subprocess.run(
        ["git", "-C", str(root), *options, *words], check=True, capture_output=True, text=True
    )
    return done.stdout.strip()


@pytest.fixture
def clone(tmp_path) -> Path:
    if shutil.which("git") is None:
        pytest.skip("Git is not installed")
    root = tmp_path / "clone"
    (root / "src" / "headway").mkdir(parents=True)
    (root / "src" / "headway" / "one.py").touch()
    git(root, "init", "--quiet")
    git(root, "add", ".")
    git(root, "commit", "--quiet", "--message", "one")
    return root


def test_every_way_to_check_out_is_read(clone):
    wanted = git(clone, "rev-parse", "HEAD")
    assert checkout.commit(clone) == wanted
    git(clone, "worktree", "add", "--quiet", "-b", "other/branch", "../further")
    assert checkout.commit(clone.parent / "further") == wanted
    git(clone, "pack-refs", "--all")
    assert checkout.commit(clone) == checkout.commit(clone.parent / "further") == wanted
    git(clone, "checkout", "--quiet", "--detach")
    assert checkout.commit(clone) == wanted


def test_where_there_is_no_commit_none_is_told(clone, tmp_path):
    assert checkout.commit(tmp_path) is None
    (clone / ".git" / "HEAD").write_text("ref: refs/heads/gone")
    assert checkout.commit(clone) is None
    (clone / ".git" / "HEAD").write_bytes(b"\xff")
    assert checkout.commit(clone) is None
    git(tmp_path, "init", "--quiet")  # a repository further up is not this one
    shutil.rmtree(clone / ".git")
    assert checkout.commit(clone) is None
    assert checkout.commit(tmp_path) is None  # nor is one without the package


def test_a_run_notes_it_and_goes_on_whatever_it_is(tmp_path, monkeypatch):
    config = make_config("pendulum", preset="smoke")
    run = RunDir(tmp_path / "run")
    monkeypatch.setattr(checkout, "commit", lambda: "a" * 40)
    run.create_or_resume(config)
    assert json.loads((run.path / "config.json").read_text())["commit"] == "a" * 40
    monkeypatch.setattr(checkout, "commit", lambda: None)
    run.create_or_resume(config)
    other = RunDir(tmp_path / "other")
    other.create_or_resume(config)
    assert "commit" not in json.loads((other.path / "config.json").read_text())
    assert run.config() == other.config()
