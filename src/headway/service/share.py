"""Push a finished run to a folder or the Hugging Face Hub, and pull one from there.

What is pushed can be loaded: the files of the newest iteration as their checksums have them, and a
model card. The Hub only carries a folder.
"""

import contextlib
import json
import tempfile
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from headway.config import differences, tolerating_as
from headway.errors import ConfigError, HeadwayError, RunError, needs, one_line
from headway.training.files import reading, write_bytes
from headway.training.methods import METHODS, make_config
from headway.training.run import RunDir, format_sim_params

HUB = "hf://"
CARD = "README.md"
TEMPLATE = Path(__file__).with_name("card.md")
PARTS = (CARD, "*.json", "*.jsonl", "*.csv", "*/iteration-*")


def push(run_dir: str | Path, target: str | Path, *, data: bool = False) -> str:
    """Copy a finished run and its model card to where others can pull it from.

    Args:
        run_dir: The run directory.
        target: A folder, or `hf://user/name` for the Hugging Face Hub, where a new model is
            private. An earlier state of the same run there is brought up to date.
        data: Also copy the episodes it was trained on. Without them it cannot be trained further,
            and heads that keep learning while they act cannot be loaded.

    Returns:
        The target.

    Raises:
        RunError: It is no run, not finished or damaged, or the target holds something else.
        ConfigError: Its heads keep learning, and the data would be left out; or a package is
            missing.
    """
    run = RunDir(run_dir)
    config = run.finished_config()
    if config.planner.adaptation != "none" and not data:
        raise ConfigError(f"the heads of {run.path} learn from its data; push it with --data.")
    files = run.files(data=data)
    with _hub(target, ["config.json", "checksums/*"]) as (folder, send):
        files[CARD] = _card(run, str(target)).encode()
        _copy(run, files, folder, str(target))
        send(f"{config.method} on {config.env}, seed {config.seed}")
    return str(target)


def pull(source: str | Path, run_dir: str | Path) -> Path:
    """Copy a run that was pushed into a run directory, and check all of it.

    Args:
        source: A folder, or `hf://user/name`.
        run_dir: A new directory, or one with an earlier state of the same run.

    Returns:
        The run directory.

    Raises:
        RunError: There is no run, it is damaged, or the directory holds something else.
        ConfigError: A package is missing.
    """
    with _hub(source, PARTS) as (folder, _):
        run = RunDir(folder)
        run.config()
        files = run.files()
        with contextlib.suppress(OSError):  # one's own note is no part of the run
            files[CARD] = (folder / CARD).read_bytes()
        _copy(run, files, Path(run_dir), str(run_dir))
    return Path(run_dir)


def _copy(run: RunDir, files: dict[str, bytes], folder: Path, name: str) -> None:
    """Write a run's files, the checksums last, since they make it count; nothing is deleted.

    Raises:
        RunError: The folder holds something else, or more of the run.
    """
    if any(folder.glob("[!.]*")):
        later = RunDir(folder).finished_iterations > run.finished_iterations
        if later or _identity(folder) != _identity(run.path):
            raise RunError(
                f"{name} holds another run or a later state of it, allowed: a new folder, or an"
                " earlier state of the same run."
            )
    for path in sorted(files, key=lambda path: path.startswith("checksums/")):
        write_bytes(folder / path, files[path])


def _identity(folder: Path) -> Any:
    """What of a run's `config.json` stays as the run becomes longer."""
    path = folder / "config.json"
    with reading(path):
        values = json.loads(path.read_bytes())
        values["config"]["collection"]["num_iterations"] = None
        return values


@contextlib.contextmanager
def _hub(target: str | Path, wanted: Sequence[str]) -> Iterator[tuple[Path, Callable[[str], Any]]]:
    """A folder with what a target holds of the wanted files, and what sends the folder there.

    Raises:
        ConfigError: The Hub's client is not installed.
        RunError: The Hub refuses, or the model there is no run.
    """
    if not str(target).startswith(HUB):
        yield Path(target), lambda message: None
        return
    needs("hub", "huggingface_hub")
    from huggingface_hub import HfApi
    from huggingface_hub.errors import RepositoryNotFoundError

    name = str(target).removeprefix(HUB)
    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(temporary) / "run"

        def send(message: str) -> None:
            api.create_repo(name, private=True, exist_ok=True)
            api.upload_folder(repo_id=name, folder_path=folder, commit_message=message)

        try:
            api = HfApi()
            with contextlib.suppress(RepositoryNotFoundError):
                names = [path for path in api.list_repo_files(name) if not path.startswith(".")]
                if names and "config.json" not in names:
                    raise RunError(f"{target} holds no run, allowed: a new name, or that of a run.")
                api.snapshot_download(name, local_dir=folder, allow_patterns=[*wanted])
            folder.mkdir(exist_ok=True)
            yield folder, send
        except HeadwayError as error:
            raise type(error)(str(error).replace(str(folder), str(target))) from None
        except Exception as error:  # whatever the network and its client do
            raise RunError(
                f"{target}: {type(error).__name__}: {one_line(error, 300)}; check the name, the"
                " network, and `hf auth login`."
            ) from None


def _card(run: RunDir, source: str) -> str:
    """The model card: what the run is, what it earned, how to load it."""
    config, rows = run.config(), run.evaluation()
    begun = json.loads((run.path / "config.json").read_bytes())
    tested: dict[str, list[float]] = {}
    for row in (row for row in rows if row.iteration == rows[-1].iteration):
        place = f"{row.group} | {format_sim_params(row.sim_params)}"
        tested.setdefault(place, []).append(row.episode_return)
    tests = (
        f"| {place} | {len(returns)} | {np.mean(returns):,.1f} ± {np.std(returns):,.1f} |"
        for place, returns in tested.items()
    )
    usual = make_config(config.env, method=config.method, preset=config.preset, seed=config.seed)
    changed = differences(tolerating_as(usual, config), config) or ["none"]
    module, _, own = config.env.rpartition(":")
    return TEMPLATE.read_text(encoding="utf-8").format(
        config=config,
        method=METHODS[config.method],
        timesteps=run.metrics()[-1]["timesteps"],
        device=begun["device"],
        own=f"It needs the module `{module}` with the EnvSpec `{own}`." if module else "",
        source=source,
        copy=f"runs/{config.env.replace(':', '-')}-{config.method}",
        tests="\n".join(tests),
        changed="; ".join(changed),
        versions=", ".join(f"{name} {number}" for name, number in begun["versions"].items()),
    )
