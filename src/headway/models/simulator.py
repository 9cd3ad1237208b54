"""The simulator itself as a model: an environment's ceiling.

What it believes is the state and the physics that the environments have at that moment.
"""

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.experimental import io_callback
from jaxtyping import Array, Float

from headway.config import Precision
from headway.models.base import Dynamics, Keys, Model, Transition, over_rows
from headway.task import Task, env_action

if TYPE_CHECKING:
    from headway.envs.built_in import ClassicVectorEnv


class Physics(NamedTuple):
    """States of environments of a classic world, and their physics."""

    state: Float[Array | np.ndarray, "*env state"]
    sim_params: Mapping[str, Float[Array | np.ndarray, "*env"]]


class ClassicSimulator(Model):
    """The equations of a classic world."""

    vector: "ClassicVectorEnv" = eqx.field(static=True)
    """The environments that are acted in."""
    task: Task

    def init_belief(self, num_envs: int, sim_params: None = None) -> Physics:
        """See `Model.init_belief`."""
        return self._now()

    def observe(self, belief: Physics, transition: Transition, keys: Keys) -> Physics:
        """See `Model.observe`: look at the environments, which move; so it is no pure function."""
        like = jax.tree.map(lambda x: jax.ShapeDtypeStruct(x.shape, x.dtype), belief)
        return io_callback(self._now, like, ordered=True)

    def dynamics(self, belief: Physics, precision: Precision = "float32") -> "ClassicDynamics":
        """See `Model.dynamics`."""
        return ClassicDynamics(belief, self.task, self.vector.world)

    def _now(self) -> Physics:
        return Physics(
            self.vector.states.astype(np.float32),
            {name: x.astype(np.float32) for name, x in self.vector.sim_params.items()},
        )


class ClassicDynamics(Dynamics):
    """A classic world's step; the state is carried."""

    own: Physics
    task: Task
    world: Any = eqx.field(static=True)

    def start(self) -> Float[Array, "1 state"]:
        """See `Dynamics.start`."""
        return jnp.asarray(self.own.state)[None]

    def step(self, carry, obs, action, noise):
        """See `Dynamics.step`."""

        def advance(state, scaled):
            force = self.task.clip_action(self.task.scale_action(scaled))
            return self.world.next_state(state, force, self.own.sim_params, jnp)

        after = over_rows(advance)(carry, action)
        return after, over_rows(lambda state: self.world.observe(state, jnp))(after)


class EnvSimulator(Model):
    """Environments that JAX cannot trace; they try whole candidates from where they are."""

    vector: Any = eqx.field(static=True)
    """The environments that are acted in; `try_out` gives returns."""
    task: Task
    traceable = False

    def dynamics(self, belief: tuple[()], precision: Precision = "float32") -> "EnvSimulator":
        """Itself."""
        return self

    def returns(
        self, candidates: Float[Array | np.ndarray, "env candidate horizon action"]
    ) -> Float[np.ndarray, "env candidate"]:
        """Sums of rewards; not finite where a simulator gives up on a candidate.

        Args:
            candidates: Action sequences in [-1, 1].
        """
        actions = env_action(self.task, np.asarray(candidates))
        return np.array([self.vector.try_out(i, own) for i, own in enumerate(actions)], np.float32)
