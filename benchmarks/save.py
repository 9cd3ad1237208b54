"""Copies the latest results to `results/speed/KIND/DATE*`, where they can be committed.

    python benchmarks/save.py

KIND is the kind of machine, `cpu-2-cores` or `h100` for example; DATE is the day of measuring.
"""

import json
import shutil
from pathlib import Path

from reporting import LATEST

SPEED = Path(__file__).parents[1] / "results" / "speed"


def save(latest: Path, speed: Path) -> list[Path]:
    """Copy every result with its table and figure.

    Args:
        latest: Where the benchmarks write.
        speed: Holds one folder per kind of machine.
    """
    saved = []
    for result in sorted(latest.glob("*.json")):
        about = json.loads(result.read_text())
        suffix = "" if result.stem == "bench" else f"-{result.stem}"
        folder = speed / about["kind"]
        folder.mkdir(parents=True, exist_ok=True)
        for path in sorted(latest.glob(f"{result.stem}.*")):
            saved.append(folder / f"{about['date']}{suffix}{path.suffix}")
            shutil.copyfile(path, saved[-1])
    return saved


def main() -> None:
    """Save, and say what was saved."""
    saved = save(LATEST, SPEED)
    if not saved:
        raise SystemExit("error: nothing to save yet; run make bench first.")
    for path in saved:
        print(path.relative_to(SPEED.parents[1]))


if __name__ == "__main__":
    main()
