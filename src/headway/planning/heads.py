"""Which prediction head plans (equation 3 of the paper; released `core/utils.py`)."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray

from headway.config import PlannerConfig
from headway.data import History
from headway.models.dynamics import MultiHeadDynamics, Statistics, network_input
from headway.task import Task

ERROR_DRAWS = 20  # noise draws of the released code's sampled error


class RecentTransitions(NamedTuple):
    """The newest transitions of each environment, the newest in the last slot."""

    obs: Float[Array, "env slot obs"]
    action: Float[Array, "env slot action"]
    next_obs: Float[Array, "env slot obs"]
    count: Int[Array, " env"]

    @classmethod
    def empty(cls, num_envs: int, num_slots: int, task: Task) -> "RecentTransitions":
        """No transitions yet."""
        obs = jnp.zeros((num_envs, num_slots, task.obs_size))
        action = jnp.zeros((num_envs, num_slots, task.action_size))
        return cls(obs, action, obs, jnp.zeros(num_envs, jnp.int32))

    def push(
        self,
        obs: Float[Array, "env obs"],
        action: Float[Array, "env action"],
        next_obs: Float[Array, "env obs"],
        happened: Bool[Array, " env"],
    ) -> "RecentTransitions":
        """Append one transition where it happened; the oldest falls out."""

        def shift(slots, newest):
            moved = jnp.concatenate([slots[:, 1:], newest[:, None]], axis=1)
            return jnp.where(happened[:, None, None], moved, slots)

        return RecentTransitions(
            shift(self.obs, obs),
            shift(self.action, action),
            shift(self.next_obs, next_obs),
            self.count + happened,
        )

    def history(self, length: int) -> History:
        """The last K transitions as the context encoder wants them: filled from the left."""
        used = jnp.minimum(self.count, length)
        slot = (jnp.arange(length) - used[:, None]) % length
        valid = (jnp.arange(length) < used[:, None])[..., None]

        def align(values):
            moved = jnp.take_along_axis(values[:, -length:], slot[..., None], axis=1)
            return jnp.where(valid, moved, 0.0)

        return History(align(self.next_obs - self.obs), align(self.action))

    def newest(self, config: PlannerConfig) -> tuple["RecentTransitions", Bool[Array, "env slot"]]:
        """The transitions on which heads compete, and which of the slots are used.

        The last N; the released code leaves out the newest one and thus sees N - 1.
        """
        first, last = -config.selection_length, None
        if config.selection_skips_newest:
            last = -1
        obs, action, next_obs = (x[:, first:last] for x in self[:3])
        slots = RecentTransitions(obs, action, next_obs, self.count)
        num_slots = slots.obs.shape[1]
        available = self.count - int(config.selection_skips_newest)
        used = jnp.arange(num_slots) >= num_slots - available[:, None]
        return slots, used


def head_errors(
    model: MultiHeadDynamics,
    task: Task,
    statistics: Statistics,
    recent: RecentTransitions,
    context: Float[Array, "member env context"] | None,
    *,
    sampling_key: PRNGKeyArray | None = None,
) -> Float[Array, "env member head slot"]:
    """Squared error of every head on recent transitions, averaged over dimensions.

    The error of the predicted mean in normalised units, with the current context for all
    of them. With a `sampling_key`, the error of sampled deltas in raw units, as the
    released code has it.
    """
    num_envs, num_slots = recent.obs.shape[:2]
    members = model.num_members
    x = network_input(task, statistics, recent.obs, recent.action)
    x = x.reshape(num_envs * num_slots, -1)
    x = jnp.broadcast_to(x, (members, *x.shape))
    if context is not None:
        context = jnp.repeat(context, num_slots, axis=1)
    prediction = model.forward_net(x, context)
    delta = task.target(recent.obs, recent.next_obs).reshape(num_envs * num_slots, -1)
    if sampling_key is None:
        error = prediction.mean - statistics.delta.normalize(delta)
    else:
        noise = jnp.zeros((1,))
        if prediction.logvar is not None:
            draws = jax.random.normal(sampling_key, (ERROR_DRAWS, *prediction.mean.shape))
            noise = draws * jnp.exp(0.5 * prediction.logvar)
        error = statistics.delta.denormalize(prediction.mean + noise) - delta
    squared = jnp.square(error).mean(-1)
    if squared.ndim == 4:
        squared = squared.mean(0)
    per_slot = squared.reshape(members, model.num_heads, num_envs, num_slots)
    return per_slot.transpose(2, 0, 1, 3)


def select_heads(
    errors: Float[Array, "env member head slot"],
    used: Bool[Array, "env slot"],
    *,
    key: PRNGKeyArray,
) -> Int[Array, "env member"]:
    """The head that best explains the used transitions; a random one when there is none.

    Ties go to the lower index; a non-finite error never wins over a finite one.
    """
    total = jnp.where(used[:, None, None, :], errors, 0.0).sum(-1)
    best = jnp.argmin(jnp.where(jnp.isfinite(total), total, jnp.inf), axis=-1)
    guess = jax.random.randint(key, best.shape, 0, errors.shape[2])
    return jnp.where(used.any(-1)[:, None], best, guess)
