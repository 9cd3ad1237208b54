"""Balance Gymnasium's double pendulum on a cart while the mass of its upper pole is unknown.

In this folder: `headway train double_pendulum:spec --preset quick`. Deviations grow by half in
every step, so it plans feedback (`ilqr`). Untrained it falls at once: an iteration collects 500
steps at least, at first in many rounds of ten episodes.
"""

import jax.numpy as jnp

import headway

POLE = 0.6  # length of each pole (m)


class DoublePendulumTask(headway.Task):
    """obs = (cart x, sin of both angles, cos of both, three velocities, a constraint's force)."""

    def tip(self, obs):
        """Position of the upper pole's end (m); the second angle is relative to the first."""
        sin, cos = obs[..., 1:3], obs[..., 3:5]
        sin_both = sin[..., 0] * cos[..., 1] + cos[..., 0] * sin[..., 1]
        cos_both = cos[..., 0] * cos[..., 1] - sin[..., 0] * sin[..., 1]
        return obs[..., 0] + POLE * (sin[..., 0] + sin_both), POLE * (cos[..., 0] + cos_both)

    def reward(self, obs, action, next_obs):
        x, y = self.tip(next_obs)
        away = 0.01 * jnp.square(x) + jnp.square(y - 2)
        fast = 1e-3 * jnp.square(next_obs[..., 6]) + 5e-3 * jnp.square(next_obs[..., 7])
        return 10.0 * (y > 1) - away - fast

    def terminated(self, obs, action, next_obs):
        return self.tip(next_obs)[1] <= 1


spec = headway.EnvSpec(
    env_id="InvertedDoublePendulum-v5",
    make_task=DoublePendulumTask,
    sim_params=headway.SimParamSets(
        train={"body:pole2.mass": (0.5, 1.0, 2.0)},
        unseen={
            "light": {"body:pole2.mass": (0.3, 0.4)},
            "heavy": {"body:pole2.mass": (2.5, 3.0)},
        },
    ),
    quick={
        "collection.num_iterations": 6,
        "collection.num_episodes": 10,
        "collection.min_steps": 500,
        "fitting.epochs": 1,
        "fitting.min_updates": 2500,
        "planner.optimizer.name": "ilqr",
        "planner.horizon": 30,
        "planner.num_candidates": 8,
        "planner.num_iterations": 2,
        "evaluation.every": 6,
        "evaluation.num_episodes": 10,
    },
)
