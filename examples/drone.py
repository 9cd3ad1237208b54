"""Hold the height of a drone whose load is unknown; the environment is written here, in NumPy.

Run `python drone.py` in this folder: it trains, and tests the controller on heavier loads.
"""

import gymnasium
import jax.numpy as jnp
import numpy as np

import headway


class Drone(gymnasium.Env):
    """obs = (height above the goal in m, climb in m/s); action = thrust in newtons."""

    observation_space = gymnasium.spaces.Box(-np.inf, np.inf, (2,), np.float64)
    action_space = gymnasium.spaces.Box(0.0, 40.0, (1,), np.float32)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.set_sim_params((options or {}).get("sim_params", {"mass": 1.0}))
        self.state = self.np_random.uniform(-1, 1, 2)
        return self.state.copy(), {"sim_params": {"mass": self.mass}}

    def set_sim_params(self, values):
        self.mass = values["mass"]  # kg

    def step(self, action):
        climb = self.state[1] + 0.05 * (float(action[0]) / self.mass - 9.81)
        self.state = np.array([self.state[0] + 0.05 * climb, climb])
        away = abs(float(self.state[0]))
        return self.state.copy(), 1 - away / 5, away > 5, False, {}


class HoverTask(headway.Task):
    def reward(self, obs, action, next_obs):
        return 1 - jnp.abs(next_obs[..., 0]) / 5

    def terminated(self, obs, action, next_obs):
        return jnp.abs(next_obs[..., 0]) > 5


spec = headway.EnvSpec(
    env_id=Drone,
    make_task=HoverTask,
    sim_params=headway.SimParamSets({"mass": (0.5, 1.0, 1.5)}, {"heavy": {"mass": (2.0,)}}),
    episode_length=100,
)
if __name__ == "__main__":
    print(headway.train(spec, preset="quick"))
