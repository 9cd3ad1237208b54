"""Names, actions and physics that the tests of the environments share."""

import numpy as np

from headway import envs
from headway.task import env_spec

NAMES = ("pendulum", "cartpole-swingup", "hopper", "slim-humanoid", "half-cheetah", "crippled-ant")
ROBOTS = NAMES[2:]


def actions_of(name: str, style: str, steps: int, seed: int = 0) -> np.ndarray:
    """Sequences a planner might try: random, at the bounds, smooth, or at rest."""
    space = envs.make(name).action_space
    rng, size = np.random.default_rng(seed), space.shape[0]
    raw = {
        "random": rng.uniform(-1, 1, (steps, size)),
        "extreme": np.sign(rng.standard_normal((steps, size))),
        "sine": np.sin(0.3 * np.arange(steps)[:, None] + rng.uniform(0, 2 * np.pi, size)),
        "rest": np.zeros((steps, size)),
    }[style]
    return (space.low + 0.5 * (raw + 1) * (space.high - space.low)).astype(np.float32)


def record(env, actions, **reset):
    """Run an episode; return observations, actions and rewards as arrays."""
    obs = [env.reset(**reset)[0]]
    rewards = []
    for action in actions:
        step = env.step(action)
        obs.append(step[0])
        rewards.append(step[1])
    return np.array(obs), np.array(actions), np.array(rewards)


def all_physics(name: str) -> list[dict[str, float]]:
    """Every training and unseen physics of an environment, in full; also with a gain."""
    sets, default = env_spec(name).sim_params, env_spec(name).default_sim_params
    gains = [{}, {"gain": -0.7}] if "gain" in default else [{}]
    rows = [values for group in sets.group_names for values in sets.group(group)]
    return [{**default, **values, **gain} for gain in gains for values in rows]


def distinct_physics(name: str, number: int) -> dict[str, np.ndarray]:
    """Different physics for each of some environments."""
    rows = [all_physics(name)[i % len(all_physics(name))] for i in range(number)]
    return {key: np.array([row[key] for row in rows]) for key in rows[0]}


def assert_same(left, right):
    """What two vector environments returned is the same, to the bit."""
    for a, b in zip(left[:-1], right[:-1], strict=True):
        assert a.dtype == b.dtype
        np.testing.assert_array_equal(a, b)
    assert left[-1].keys() == right[-1].keys() == {"sim_params"}
    for name, values in left[-1]["sim_params"].items():
        np.testing.assert_array_equal(values, right[-1]["sim_params"][name])
