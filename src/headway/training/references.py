"""Returns of random actions and of the paper's planner on the true dynamics.

They normalise returns: score = (return - random) / (ceiling - random). They were measured
before this package was, with 16 (Pendulum) and 12 (CartPoleSwingUp) full episodes per value;
results/ceilings has measured them again. CartPoleSwingUp's ceiling is no upper bound for heavy
poles. Its masses 0.15, 0.25 and 2.75, and all of its shorter episodes, are from results/ceilings,
with 16 episodes per unseen and 8 per training value.
"""

from collections.abc import Mapping

from headway.config import Config
from headway.errors import ConfigError
from headway.task import env_options, env_spec, episode_length
from headway.training.run import EpisodeRow

_PENDULUM = {  # length: (random, ceiling), 200 steps
    0.25: (-1748.0, -539.0),
    0.375: (-1622.0, -239.0),
    0.5: (-1501.0, -126.0),
    0.75: (-1271.0, -107.0),
    1.0: (-1143.0, -131.0),
    1.25: (-1110.0, -170.0),
    1.5: (-1041.0, -203.0),
    1.75: (-1000.0, -240.0),
}

_CARTPOLE_SWINGUP = {  # mass scale: (random, ceiling), 500 steps
    0.1: (215.0, 489.0),
    0.15: (206.7, 486.7),
    0.2: (183.0, 484.0),
    0.25: (193.0, 482.7),
    0.3: (146.0, 481.0),
    0.5: (89.0, 462.0),
    1.0: (33.0, 347.0),
    1.5: (22.0, 233.0),
    2.5: (16.0, 135.0),
    2.75: (13.3, 110.4),
    3.0: (14.0, 105.0),
}

_SHORT_CARTPOLE_SWINGUP = {  # mass scale: (random, ceiling), 200 steps
    0.1: (83.8, 189.1),
    0.15: (68.6, 186.7),
    0.25: (47.5, 182.7),
    0.5: (20.4, 155.3),
    1.5: (1.6, 35.8),
    2.5: (2.0, 15.7),
    2.75: (1.9, 13.8),
    3.0: (3.5, 14.3),
}

_TABLES = {  # by environment and steps of an episode: what varies, and the returns
    ("pendulum", 200): ("length", _PENDULUM),
    ("cartpole-swingup", 500): ("mass_scale", _CARTPOLE_SWINGUP),
    ("cartpole-swingup", 200): ("mass_scale", _SHORT_CARTPOLE_SWINGUP),
}

_MEASURED = {env for env, _ in _TABLES}


def score_of(row: EpisodeRow, config: Config) -> float | None:
    """Score of one test episode; None where no reference was measured with the run's protocol.

    Options of the environment that differ from the defaults make it another one. An episode that
    ended early counts with what it earned.

    Args:
        row: The episode.
        config: Settings of the run that was tested.
    """
    if config.env not in _MEASURED or env_options(config) != env_spec(config.env).options:
        return None
    return score(config.env, row.sim_params, row.episode_return, episode_length(config))


def score(
    env: str, sim_params: Mapping[str, float], episode_return: float, length: int
) -> float | None:
    """Normalise a return: 0 is random, 1 the paper's planner on the true dynamics.

    Args:
        env: Short name of the environment.
        sim_params: The episode's simulator parameters.
        episode_return: Sum of rewards.
        length: Steps of an episode, if it does not end early.

    Returns:
        The score, or None where no reference is known for these physics and this length.
    """
    if (env, length) not in _TABLES:
        return None
    name, table = _TABLES[env, length]
    others_nominal = all(value == 1.0 for other, value in sim_params.items() if other != name)
    if sim_params.get(name) not in table or not others_nominal:
        return None
    random, ceiling = table[sim_params[name]]
    return normalised(episode_return, random, ceiling)


def normalised(episode_return: float, random: float, ceiling: float) -> float:
    """Score of a return: 0 as random actions, 1 as the planner on the true dynamics.

    Args:
        episode_return: What is scored.
        random: Mean return of random actions.
        ceiling: Mean return of the planner on the true dynamics.

    Raises:
        ConfigError: Both references are the same, so that nothing lies between them.
    """
    if random == ceiling:
        raise ConfigError(
            f"random actions and true dynamics both return {random}, allowed: two references that"
            " differ; report the return instead."
        )
    return (episode_return - random) / (ceiling - random)
