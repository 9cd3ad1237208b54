# pyright: reportAttributeAccessIssue=false
# (the names compiled into mujoco have no stubs)

"""Futures of robots: many action sequences rolled out from where an environment is now."""

import mujoco
import mujoco.rollout
import numpy as np
from jaxtyping import Float

from headway.cpus import num_cpus
from headway.envs.built_in import RobotVectorEnv
from headway.envs.locomotion import RobotState

_PHYSICS = mujoco.mjtState.mjSTATE_FULLPHYSICS.value
_CONTROL = mujoco.mjtState.mjSTATE_CTRL.value


class RobotFutures:
    """Rolls action sequences out on `mujoco.rollout`'s threads, one per CPU.

    The environments themselves are not touched. A future repeats what they will do to the bit:
    same physics, same constraint solver's warm start.
    """

    def __init__(self, vector: RobotVectorEnv):
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
        """Return the states before and after every step, [candidate, horizon, ...].

        Where MuJoCo gives up on a sequence, its states are NaN.

        Args:
            i: The environment to start from.
            actions: In the environment's own units, within its bounds.
        """
        world, model, data = self.vector.world, self._model, self.vector.datas[i]
        sim_params = {name: float(values[i]) for name, values in self.vector.sim_params.items()}
        world.set_physics(model, sim_params)
        count, horizon = actions.shape[:2]
        skip, nq, nv = world.frame_skip, model.nq, model.nv
        start = np.empty(mujoco.mj_stateSize(model, _PHYSICS))
        mujoco.mj_getState(self.vector.models[i], data, start, _PHYSICS)
        found, _ = self._rollout.rollout(
            model,
            self._datas,
            np.tile(start, (count, 1)),
            np.repeat(world.control(actions, sim_params), skip, axis=1),
            control_spec=_CONTROL,
            initial_warmstart=np.tile(data.qacc_warmstart, (count, 1)),
        )
        states = np.asarray(found)
        # Given up: numbers too large for MuJoCo, or its clock, the first of them, stands still.
        end = start[0] + (states.shape[1] - 0.5) * model.opt.timestep
        sound = (np.abs(states) < mujoco.mjMAXVAL).all((1, 2)) & (states[:, -1, 0] > end)
        states[~sound] = np.nan
        first = np.broadcast_to(start, (count, 1, len(start)))
        reached = np.concatenate([first, states[:, skip - 1 :: skip]], axis=1)
        qpos, qvel = reached[..., 1 : 1 + nq], reached[..., 1 + nq : 1 + nq + nv]
        before = RobotState(qpos[:, :-1], qvel[:, :-1], np.zeros((count, horizon)))
        after = world.after_step(before, qpos[:, 1:], qvel[:, 1:])
        now = np.full((count, 1), self.vector.velocity[i])
        velocity = np.concatenate([now, after.velocity[:, :-1]], axis=1)
        return before._replace(velocity=velocity), after
