"""Runs that are pushed and pulled: whole, checked, and never over something else."""

import json
import shutil

import huggingface_hub
import numpy as np
import pytest
from huggingface_hub.errors import RepositoryNotFoundError

import headway
from headway.errors import ConfigError, HeadwayError, RunError
from headway.training.run import RunDir
from runs import random_config, result


class FakeHub:
    """What `push` and `pull` use of `HfApi`, on folders; the network is not tested."""

    folder = None

    def list_repo_files(self, name):
        if not (self.folder / name).exists():
            raise RepositoryNotFoundError.__new__(RepositoryNotFoundError)
        found = (path for path in (self.folder / name).rglob("*") if path.is_file())
        return [path.relative_to(self.folder / name).as_posix() for path in found]

    def snapshot_download(self, name, *, local_dir, allow_patterns):
        for path in huggingface_hub.utils.filter_repo_objects(
            self.list_repo_files(name), allow_patterns=allow_patterns
        ):
            (local_dir / path).parent.mkdir(parents=True, exist_ok=True)
            shutil.copy(self.folder / name / path, local_dir / path)

    def create_repo(self, name, *, private, exist_ok):
        assert (private, exist_ok) == (True, True)
        (self.folder / name).mkdir(parents=True, exist_ok=True)
        (self.folder / name / ".gitattributes").touch()

    def upload_folder(self, *, repo_id, folder_path, commit_message):
        assert commit_message == "tmcl on pendulum, seed 0"
        shutil.copytree(folder_path, self.folder / repo_id, dirs_exist_ok=True)


@pytest.fixture(params=["folder", "hub"])
def target(request, tmp_path, monkeypatch):
    monkeypatch.setattr(huggingface_hub, "HfApi", FakeHub)
    monkeypatch.setattr(FakeHub, "folder", tmp_path / "hub")
    return "hf://user/name" if request.param == "hub" else str(tmp_path / "pushed")


@pytest.mark.parametrize("data", [False, True])
def test_what_is_pulled_is_the_run_that_was_pushed(data, target, reference, tmp_path):
    before = result(reference)
    for _ in range(2):  # again, over what is there
        assert headway.push(reference, target, data=data) == target
        pulled = headway.pull(target, tmp_path / "pulled")
    assert result(reference) == before
    obs = np.float32([1.0, 0.0, 0.0])
    assert headway.load(pulled).act(obs) == headway.load(reference).act(obs)
    assert RunDir(pulled).evaluation() == RunDir(reference).evaluation()
    assert RunDir(pulled).tests().keys() == {"train", "low", "high"}
    if data:
        RunDir(pulled).check()
    else:
        with pytest.raises(RunError, match=r"data/iteration-000\.safetensors is missing"):
            RunDir(pulled).check()
    card = huggingface_hub.ModelCard((pulled / "README.md").read_text())
    assert card.data.library_name == "headway"
    last = [row for row in RunDir(reference).evaluation() if row.iteration == 2]
    earned = f"{last[2].episode_return:,.1f} ± 0.0"
    assert f"| low | length=0.25 mass=1 | 1 | {earned} |" in card.text
    assert f"headway pull {target} runs/pendulum-tmcl" in card.text
    assert "planner.horizon: 4 -> 3" in card.text


def test_a_run_that_went_on_is_brought_up_to_date_and_never_set_back(
    two_iterations, reference, target, tmp_path
):
    shorter = shutil.copytree(two_iterations, tmp_path / "shorter")
    RunDir(shorter)._lengthen(2)
    headway.push(shorter, target)
    pulled = headway.pull(target, tmp_path / "pulled")
    assert RunDir(pulled).finished_iterations == 2
    headway.push(reference, target)
    headway.pull(target, pulled)
    assert RunDir(pulled).finished_iterations == 3
    refused("a later state of it", headway.push, shorter, target)
    complete = result(shutil.copytree(reference, tmp_path / "own"))
    for take, *places in (
        (headway.pull, target, tmp_path / "own"),
        (headway.push, *2 * [tmp_path / "own"]),
    ):
        take(*places)  # data and older iterations stay
        (tmp_path / "own/README.md").unlink()
        assert result(tmp_path / "own") == complete


def test_data_that_was_sent_once_is_not_asked_for_later(
    two_iterations, reference, target, tmp_path
):
    shorter = shutil.copytree(two_iterations, tmp_path / "shorter")
    RunDir(shorter)._lengthen(2)
    headway.push(shorter, target, data=True)
    headway.push(reference, target)
    pulled = RunDir(headway.pull(target, tmp_path / "pulled"))
    assert pulled.finished_iterations == 3
    assert not (pulled.path / "data").exists()
    headway.push(reference, target, data=True)
    RunDir(headway.pull(target, pulled.path)).check()


def refused(error, function, *args):
    with pytest.raises(HeadwayError, match=error) as caught:
        function(*args)
    assert "\n" not in str(caught.value)


def test_what_is_not_pushed(target, reference, two_iterations, tmp_path):
    (tmp_path / "empty").mkdir()
    refused("no finished run|config.json is missing", headway.push, tmp_path / "empty", target)
    refused("2 of 3 iterations, allowed: a finished run", headway.push, two_iterations, target)
    damaged = shutil.copytree(reference, tmp_path / "damaged")
    (damaged / "checkpoints/iteration-002.safetensors").write_bytes(b"")
    refused("is damaged", headway.push, damaged, target)
    other = RunDir(tmp_path / "other")
    other.begin(random_config())
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(huggingface_hub, "HfApi", FakeHub)
        for taken in (tmp_path / "damaged/data", other.path):
            refused("config.json is missing|holds another run", headway.push, reference, taken)
        refused(
            "cannot be written: File exists", headway.push, reference, reference / "config.json"
        )
        shutil.copytree(tmp_path / "damaged/data", tmp_path / "hub/user/data")
        refused("holds no run", headway.push, reference, "hf://user/data")
    assert not (tmp_path / "pushed").exists()


@pytest.mark.parametrize("name", ["checkpoints/iteration-002.safetensors", "evaluation.csv"])
def test_what_is_damaged_on_the_way_is_not_pulled(name, reference, target, tmp_path):
    headway.push(reference, target)
    place = tmp_path / ("hub/user/name" if target.startswith("hf:") else "pushed")
    content = bytearray((place / name).read_bytes())
    content[len(content) // 2] ^= 1
    (place / name).write_bytes(content)
    refused(f"{target}/{name} is damaged", headway.pull, target, tmp_path / "pulled")
    assert not (tmp_path / "pulled").exists()


def test_a_pulled_run_writes_nowhere_else(reference, target, tmp_path):
    headway.push(reference, target)
    place = tmp_path / ("hub/user/name" if target.startswith("hf:") else "pushed")
    path = place / "checksums/iteration-002.json"
    path.write_text(json.dumps({**json.loads(path.read_text()), "../stray.json": {"bytes": 0}}))
    refused(r"names '\.\./stray\.json', no file of a run", headway.pull, target, tmp_path / "p")
    refused("missing|not a directory|holds no run", headway.pull, f"{target}2", tmp_path / "p")
    assert not (tmp_path / "p").exists()


def test_a_client_that_is_missing_and_heads_that_need_data(reference, tmp_path, monkeypatch):
    monkeypatch.setattr("headway.errors.find_spec", lambda name: None)
    with pytest.raises(ConfigError, match=r"'headway\[hub\]'"):
        headway.pull("hf://user/name", tmp_path / "a")
    values = json.loads((reference / "config.json").read_bytes())
    values["config"]["planner"]["adaptation"] = "last-layer"
    learns = shutil.copytree(reference, tmp_path / "learns")
    (learns / "config.json").write_text(json.dumps(values))
    with pytest.raises(ConfigError, match="push it with --data"):
        headway.push(learns, tmp_path / "a")
