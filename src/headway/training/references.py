"""Returns of random actions and of the paper's planner on the true dynamics.

They normalise returns: score = (return - random) / (ceiling - random). They were measured
before this package was, with 16 (Pendulum) and 12 (CartPoleSwingUp) full episodes per value;
results/ceilings has measured them again. CartPoleSwingUp's ceiling is no upper bound for heavy
poles. Its masses 0.15, 0.25 and 2.75, and all of its shorter episodes, are from results/ceilings,
with 16 episodes per unseen and 8 per training value.
"""

import csv
import importlib.resources
from collections.abc import Mapping

from headway.config import Config
from headway.task import env_options, env_spec, episode_length
from headway.training.run import EpisodeRow

with (importlib.resources.files("headway.training") / "references.csv").open() as _file:
    _ROWS = list(csv.DictReader(_file))
_REFERENCES = {
    (row["env"], int(row["steps"]), row["sim_param"], float(row["value"])): (
        float(row["random"]),
        float(row["ceiling"]),
    )
    for row in _ROWS
}


def score_of(row: EpisodeRow, config: Config) -> float | None:
    """Score of one test episode; None where no reference was measured with the run's protocol.

    Options of the environment that differ from the defaults make it another one. An episode that
    ended early counts with what it earned.

    Args:
        row: The episode.
        config: Settings of the run that was tested.
    """
    if env_options(config) != env_spec(config.env).options:
        return None
    return score(config.env, row.sim_params, row.episode_return, episode_length(config))


def score(
    env: str, sim_params: Mapping[str, float], episode_return: float, length: int
) -> float | None:
    """Normalise a return: 0 is random, 1 the paper's planner on the true dynamics.

    Args:
        env: Short name of the environment.
        sim_params: The episode's simulator parameters; others are the unchanged environment's.
        episode_return: Sum of rewards.
        length: Steps of an episode, if it does not end early.

    Returns:
        The score, or None where no reference is known for these physics and this length.
    """
    sim_params = {**env_spec(env).default_sim_params, **sim_params}
    for name, value in sim_params.items():
        found = _REFERENCES.get((env, length, name, value))
        others_nominal = all(sim_params[other] == 1.0 for other in sim_params if other != name)
        if found and others_nominal:
            random, ceiling = found
            return (episode_return - random) / (ceiling - random)
    return None
