"""Walk with Gymnasium's Walker2d while the floor's friction is unknown.

In this folder: `headway check walker:spec`, then `headway train walker:spec --preset quick`.
"""

import jax.numpy as jnp

import headway

STEP = 0.008  # seconds of a step


class WalkerTask(headway.Task):
    """obs = (x, height, torso's angle, six joints, and the nine velocities)."""

    def reward(self, obs, action, next_obs):
        velocity = (next_obs[..., 0] - obs[..., 0]) / STEP
        upright = jnp.where(self.terminated(obs, action, next_obs), 0.0, 1.0)
        return velocity + upright - 1e-3 * jnp.square(action).sum(-1)

    def terminated(self, obs, action, next_obs):
        height, angle = next_obs[..., 1], next_obs[..., 2]
        return (height <= 0.8) | (height >= 2.0) | (jnp.abs(angle) >= 1.0)

    def preprocess(self, obs):
        return obs[..., 1:]  # the same everywhere


spec = headway.EnvSpec(
    env_id="Walker2d-v5",
    make_task=WalkerTask,
    sim_params=headway.SimParamSets(
        train={"friction": (0.5, 1.0, 2.0)},
        unseen={"slippery": {"friction": (0.3,)}, "rough": {"friction": (3.0,)}},
    ),
    options={"exclude_current_positions_from_observation": False},
)
