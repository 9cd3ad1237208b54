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
from headway.errors import ConfigError, HeadwayError, RunError, one_line
from headway.service import needs
from headway.training.files import reading, write_bytes
from headway.training.methods import METHODS, make_config
from headway.training.run import RunDir, format_sim_params

HUB = "hf://"
CARD = "README.md"
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
    config, finished = run.config(), run.finished_iterations
    if finished < config.collection.num_iterations:
        raise RunError(
            f"{run.path} has {finished} of {config.collection.num_iterations} iterations, allowed:"
            " a finished run; go on training it with the same `headway train` command."
        )
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
        files = run.files(data=(folder / "data").is_dir())
        with contextlib.suppress(OSError):  # one's own note is no part of the run
            files[CARD] = (folder / CARD).read_bytes()
        _copy(run, files, Path(run_dir), str(run_dir))
    return Path(run_dir)


def _copy(run: RunDir, files: dict[str, bytes], folder: Path, name: str) -> None:
    """Write a run's files, the checksums last, since they make it count; nothing is deleted.

    Raises:
        RunError: The folder holds something else, or more of the run.
    """
    if folder.exists() and not folder.is_dir():
        raise RunError(f"{name} is a file, allowed: a folder; choose another.")
    theirs = folder / "config.json"
    if folder.exists() and any(path.name[0] != "." for path in folder.iterdir()):
        with reading(theirs):
            known = _identity(theirs.read_bytes())
        later = RunDir(folder).finished_iterations > run.finished_iterations
        if later or known != _identity(files["config.json"]):
            raise RunError(
                f"{name} holds another run or a later state of it, allowed: a new folder, or an"
                " earlier state of the same run."
            )
    for path in sorted(files, key=lambda path: path.startswith("checksums/")):
        write_bytes(folder / path, files[path])


def _identity(content: bytes) -> Any:
    """What of a `config.json` stays as a run becomes longer."""
    values = json.loads(content)
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
    needs("huggingface_hub", "hub")
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
    config, metrics, rows = run.config(), run.metrics(), run.evaluation()
    begun = json.loads((run.path / "config.json").read_bytes())
    scores, table = [], ["| group | physics | episodes | return |", "|---|---|---|---|"]
    tested: dict[tuple[str, str], list[float]] = {}
    for row in (row for row in rows if row.iteration == rows[-1].iteration):
        place = row.group, format_sim_params(row.sim_params)
        tested.setdefault(place, []).append(row.episode_return)
    for physics, returns in tested.items():
        mean, name = float(np.mean(returns)), ", ".join(physics)
        table.append(
            f"| {' | '.join(physics)} | {len(returns)} | {mean:,.1f} ± {np.std(returns):,.1f} |"
        )
        scores.append({"type": "mean_reward", "name": name, "value": round(mean, 3)})
    title, method = f"{config.method} on {config.env}", config.method
    tests = {
        "task": {"type": "reinforcement-learning"},
        "dataset": {"name": config.env, "type": config.env},
        "metrics": scores,
    }
    header = {
        "library_name": "headway",
        "pipeline_tag": "reinforcement-learning",
        "tags": ["headway", "model-based-reinforcement-learning", "robotics"],
        "model-index": [{"name": title, "results": [tests]}],
    }
    usual = make_config(config.env, method=method, preset=config.preset, seed=config.seed)
    changed = differences(tolerating_as(usual, config), config) or ["none"]
    module, _, own = config.env.rpartition(":")
    copy = f"runs/{config.env.replace(':', '-')}-{method}"
    new_line = "\n"
    return f"""---
{new_line.join(f"{name}: {json.dumps(value)}" for name, value in header.items())}
---
# {title}

A controller trained by Headway: {METHODS[method].description}. Preset {config.preset}, seed
{config.seed}, {metrics[-1]["timesteps"]:,} steps of the environment, on {begun["device"]}.
{f"It needs the module `{module}` with the EnvSpec `{own}`." if module else ""}

```
headway pull {source} {copy}
headway evaluate {copy}
```

`headway.load("{copy}").act(obs)` is its next action.

## Its own tests

{new_line.join(table)}

## Settings

Other than those of method and preset: {"; ".join(changed)}. All are in `config.json`, made with
{", ".join(f"{name} {number}" for name, number in begun["versions"].items())}.
"""
