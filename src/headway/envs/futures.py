# pyright: reportAttributeAccessIssue=false
# (the names compiled into mujoco have no stubs)

"""What robots would do: many action sequences rolled out from where an environment is now."""

import mujoco
import mujoco.rollout
import numpy as np
from jaxtyping import Bool, Float

from headway.cpus import num_cpus
from headway.envs.robots import RobotState
from headway.envs.vector_worlds import RolloutVectorEnv

_PHYSICS = mujoco.mjtState.mjSTATE_FULLPHYSICS.value
_CONTROL = mujoco.mjtState.mjSTATE_CTRL.value


class RobotFutures:
    """Rolls action sequences out on `mujoco.rollout`'s threads, one per CPU.

    The environments themselves are not touched. A future repeats what they will do to the bit:
    same physics, same constraint solver's warm start.

    Args:
        vector: The environments.
    """

    def __init__(self, vector: RolloutVectorEnv):
        self.vector = vector
        self._model = vector.world.new_model()
        # A robot that MuJoCo gives up on stays where it is instead of starting over.
        self._model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_AUTORESET.value
        threads = num_cpus()
        self._datas = [mujoco.MjData(self._model) for _ in range(threads)]
        self._rollout = mujoco.rollout.Rollout(nthread=threads if threads > 1 else 0)

    def roll_out(
        self, i: int, actions: Float[np.ndarray, "candidate horizon action"]
    ) -> tuple[RobotState, RobotState]:
        """States before and after every step of every sequence, [candidate, horizon, ...].

        Where MuJoCo gives up on a sequence, its states are NaN.

        Args:
            i: The environment to start from.
            actions: In the environment's own units, within its bounds.
        """
        world, model, start = self.vector.world, self._model, self.vector.start(i)
        world.set_physics(model, start.sim_params)
        count, horizon = actions.shape[:2]
        skip = world.frame_skip
        control = np.repeat(world.control(actions, start.sim_params), skip, axis=1)
        found, _ = self._rollout.rollout(
            model,
            self._datas,
            np.tile(start.state, (count, 1)),
            control,
            control_spec=_CONTROL,
            initial_warmstart=np.tile(start.warm, (count, 1)),
        )
        states = np.asarray(found)
        assert states.shape == (count, horizon * skip, mujoco.mj_stateSize(model, _PHYSICS))
        states[_given_up(states, start.state[0], model.opt.timestep)] = np.nan
        first = np.broadcast_to(start.state, (count, 1, len(start.state)))
        reached = np.concatenate([first, states[:, skip - 1 :: skip]], axis=1)
        qpos = reached[..., 1 : 1 + model.nq]
        qvel = reached[..., 1 + model.nq : 1 + model.nq + model.nv]
        unknown = np.zeros((count, horizon))
        before = RobotState(qpos[:, :-1], qvel[:, :-1], unknown)
        after = world.after_step(before, qpos[:, 1:], qvel[:, 1:])
        now = np.full((count, 1), start.velocity)
        velocity = np.concatenate([now, after.velocity[:, :-1]], axis=1)
        return before._replace(velocity=velocity), after


def _given_up(
    states: Float[np.ndarray, "candidate time state"], begin: float, timestep: float
) -> Bool[np.ndarray, " candidate"]:
    """Where numbers are too large for MuJoCo, or its clock, the first number, stands still."""
    end = begin + (states.shape[1] - 0.5) * timestep
    sound = (np.abs(states) < mujoco.mjMAXVAL).all((1, 2)) & (states[:, -1, 0] > end)
    return ~sound
