"""Random and ceiling returns of each physics, from the tests of two methods.

python results/ceilings/summarise.py results/ceilings
"""

import csv
import sys
from collections import defaultdict
from pathlib import Path

import numpy as np

COLUMNS = ("env", "sim_params", "random", "random_std", "ceiling", "ceiling_std", "episodes")


def by_physics(table: Path) -> dict[str, list[float]]:
    """The returns of every physics."""
    found = defaultdict(list)
    with table.open(newline="") as file:
        for row in csv.DictReader(file):
            found[row["sim_params"]].append(float(row["return"]))
    return found


def rows_of(folder: Path, env: str) -> list[dict[str, object]]:
    """Means and standard deviations over episodes, the same episodes for both methods."""
    random = by_physics(folder / f"{env}-random.csv")
    ceiling = by_physics(folder / f"{env}-true-dynamics.csv")
    rows = []
    for physics in sorted(ceiling):
        low, high = np.array(random[physics]), np.array(ceiling[physics])
        assert len(low) == len(high)
        numbers = (low.mean(), low.std(), high.mean(), high.std())
        rounded = (round(float(number), 1) for number in numbers)
        rows.append(dict(zip(COLUMNS, (env, physics, *rounded, len(high)), strict=True)))
    return rows


def main(folder: Path) -> None:
    """Write `ceilings.csv` into the folder, and print it."""
    envs = sorted(path.name.removesuffix("-random.csv") for path in folder.glob("*-random.csv"))
    rows = [row for env in envs for row in rows_of(folder, env)]
    with (folder / "ceilings.csv").open("w", newline="") as file:
        writer = csv.DictWriter(file, COLUMNS, lineterminator="\n")
        writer.writeheader()
        writer.writerows(rows)
    print((folder / "ceilings.csv").read_text(), end="")


if __name__ == "__main__":
    main(Path(sys.argv[1]))
