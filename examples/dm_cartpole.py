"""Swing up dm_control's cart-pole while the pole's mass is unknown.

Needs `pip install 'headway[dm-control]'`. In this folder: `headway train dm_cartpole:spec --preset
quick`.
"""

import jax.numpy as jnp

import headway


def near_zero(number, margin):
    """What dm_control calls a tolerance: 1 at zero, 0.1 at the margin."""
    return 0.1 ** jnp.square(number / margin)


class SwingUpTask(headway.Task):
    """obs = (cart x, cos of the angle, sin, and the two velocities), flattened by Headway."""

    def reward(self, obs, action, next_obs):
        upright = (1 + next_obs[..., 1]) / 2
        centred = (1 + near_zero(next_obs[..., 0], 2.0)) / 2
        calm = (1 + near_zero(next_obs[..., 4], 5.0)) / 2
        cheap = (4 + 1 - jnp.square(action[..., 0])) / 5
        return upright * centred * calm * cheap


spec = headway.EnvSpec(
    env_id="shimmy:dm_control/cartpole-swingup-v0",
    make_task=SwingUpTask,
    sim_params=headway.SimParamSets(
        train={"body:pole_1.mass": (0.5, 1.0, 2.0)},
        unseen={"light": {"body:pole_1.mass": (0.3,)}, "heavy": {"body:pole_1.mass": (3.0,)}},
    ),
    episode_length=1000,
)
