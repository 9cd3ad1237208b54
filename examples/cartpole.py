"""Balance Gymnasium's CartPole, left or right, while the motor's force is unknown.

In this folder: `headway train cartpole:spec --preset quick`.
"""

import jax.numpy as jnp
from gymnasium.envs.classic_control import CartPoleEnv

import headway


class Cart(CartPoleEnv):
    """CartPole-v1 whose motor may be weak or strong."""

    def reset(self, *, seed=None, options=None):
        self.set_sim_params((options or {}).get("sim_params", {}))
        obs, info = super().reset(seed=seed)
        return obs, info | {"sim_params": {"force": self.force_mag}}

    def set_sim_params(self, values):
        self.force_mag = values.get("force", 10.0)  # newtons


class CartPoleTask(headway.Task):
    """obs = (x, its velocity, the pole's angle, its velocity); 1 for every step."""

    def reward(self, obs, action, next_obs):
        return jnp.ones(obs.shape[:-1])

    def terminated(self, obs, action, next_obs):
        x, angle = next_obs[..., 0], next_obs[..., 2]
        return (jnp.abs(x) > 2.4) | (jnp.abs(angle) > 12 * jnp.pi / 180)


spec = headway.EnvSpec(
    name="cartpole",
    env_id=Cart,
    make_task=CartPoleTask,
    sim_params=headway.SimParamSets(
        train={"force": (5.0, 10.0, 15.0)},
        unseen={"weak": {"force": (4.0,)}, "strong": {"force": (20.0,)}},
    ),
    episode_length=500,
)
