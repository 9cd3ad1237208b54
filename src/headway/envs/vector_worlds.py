# pyright: reportAttributeAccessIssue=false
# (the names compiled into mujoco have no stubs)

"""Vector environments of the built-in worlds: NumPy for the classic ones, MuJoCo's rollout."""

from concurrent.futures import ThreadPoolExecutor
from typing import Any, NamedTuple

import mujoco
import mujoco.rollout
import numpy as np
from gymnasium.vector import AutoresetMode

from headway.cpus import num_cpus
from headway.envs.classic import ClassicWorld
from headway.envs.robots import Robot, RobotState
from headway.envs.vector import Outcome, WorldVectorEnv
from headway.envs.world import SimParams

_PHYSICS = mujoco.mjtState.mjSTATE_FULLPHYSICS.value
_CONTROL = mujoco.mjtState.mjSTATE_CTRL.value


class ClassicVectorEnv(WorldVectorEnv):
    """Many copies of a classic world, stepped by one NumPy formula."""

    _world: ClassicWorld

    def __init__(
        self,
        world: ClassicWorld,
        num_envs: int,
        autoreset_mode: AutoresetMode | str = AutoresetMode.NEXT_STEP,
        episode_length: int | None = None,
    ):
        super().__init__(world, num_envs, autoreset_mode, episode_length)
        self._state = np.zeros((num_envs, world.state_size))

    @property
    def world(self) -> ClassicWorld:
        """The laws that all environments follow."""
        return self._world

    @property
    def states(self) -> np.ndarray:
        """The physical states [env, state] as they are now."""
        return self._state.copy()

    def _set_initial_state(self, i: int, rng: np.random.Generator) -> None:
        self._state[i] = self._world.initial_state(rng)

    def _advance(self, active: np.ndarray, actions: np.ndarray) -> Outcome:
        sim_params = {name: values[active] for name, values in self._sim_params.items()}
        step = self._world.advance(self._state[active], actions[active], sim_params)
        self._state[active] = step.state
        return Outcome(step.reward, step.terminated, np.zeros(len(active), bool))

    def _observe(self) -> np.ndarray:
        return self._world.observe(self._state)


class Start(NamedTuple):
    """Where a robot's future begins; nothing else is needed to repeat it to the bit."""

    state: np.ndarray
    """MuJoCo's full physical state."""
    warm: np.ndarray
    """The constraint solver's last result."""
    velocity: float
    """Average forward velocity over the control step that led here (m/s)."""
    sim_params: SimParams


class RolloutVectorEnv(WorldVectorEnv):
    """Many robots with an `MjModel` each, stepped by `mujoco.rollout` on several threads.

    A rollout starts from a physical state and, for the same numbers as plain stepping, from
    the constraint solver's last result (`qacc_warmstart`). One rollout of all environments
    would hide that result: threads share their `MjData` between environments and only states
    come out. So every environment has an `MjData` of its own, from which the warm start is
    read; each thread makes the rollouts of its share of the environments, during which
    Python's lock is free. This is as fast and equals `mj_step` bit for bit.
    """

    _world: Robot

    def __init__(
        self,
        robot: Robot,
        num_envs: int,
        autoreset_mode: AutoresetMode | str = AutoresetMode.NEXT_STEP,
        episode_length: int | None = None,
    ):
        super().__init__(robot, num_envs, autoreset_mode, episode_length)
        self._models = [robot.new_model() for _ in range(num_envs)]
        self._datas = [mujoco.MjData(model) for model in self._models]
        model, skip = robot.nominal, robot.frame_skip
        size = mujoco.mj_stateSize(model, _PHYSICS)
        # The second axis is the rollout's batch, here always 1.
        self._state = np.zeros((num_envs, 1, size))
        self._warm = np.zeros((num_envs, 1, model.nv))
        self._control = np.zeros((num_envs, 1, skip, model.nu))
        self._states = np.zeros((num_envs, 1, skip, size))
        self._sensors = np.zeros((num_envs, 1, skip, model.nsensordata))
        self._velocity = np.zeros(num_envs)
        num_threads = min(num_cpus(), num_envs)
        self._rollouts = [mujoco.rollout.Rollout(nthread=0) for _ in range(num_threads)]
        self._pool = ThreadPoolExecutor(num_threads - 1) if num_threads > 1 else None

    @property
    def world(self) -> Robot:
        """The laws that all environments follow."""
        return self._world

    def start(self, i: int) -> Start:
        """Where environment `i` is now."""
        sim_params = {name: float(values[i]) for name, values in self._sim_params.items()}
        velocity = float(self._velocity[i])
        return Start(self._state[i, 0].copy(), self._warm[i, 0].copy(), velocity, sim_params)

    def _set_initial_state(self, i: int, rng: np.random.Generator) -> None:
        state, data = self._world.initial_state(rng), self._datas[i]
        mujoco.mj_resetData(self._models[i], data)
        data.qpos[:], data.qvel[:] = state.qpos, state.qvel
        mujoco.mj_getState(self._models[i], data, self._state[i, 0], _PHYSICS)
        self._warm[i] = 0.0
        self._velocity[i] = state.velocity

    def _apply_sim_params(self, i: int, sim_params: SimParams) -> None:
        self._world.set_physics(self._models[i], sim_params)

    def _advance(self, active: np.ndarray, actions: np.ndarray) -> Outcome:
        robot = self._world
        before = self._robot_state()
        self._control[:] = robot.control(actions, self._sim_params)[:, None, None]
        self._roll_out(active)
        self._state[active] = self._states[active, :, -1]
        after = robot.after_step(before, *self._positions())
        self._velocity[active] = after.velocity[active]
        reward = robot.reward(before, actions, after)
        no = np.zeros(len(active), bool)
        return Outcome(reward[active], no, no, self._given_up(active))

    def _given_up(self, active: np.ndarray) -> dict[int, str]:
        """The environments that MuJoCo warns of."""
        warnings = {int(i): self._world.warning(self._datas[i]) for i in active}
        return {i: warning for i, warning in warnings.items() if warning}

    def _roll_out(self, active: np.ndarray) -> None:
        """Share the environments among the threads, this one included."""
        shares = [active[n :: len(self._rollouts)] for n in range(len(self._rollouts))]
        waiting = [
            self._pool.submit(self._roll_out_share, rollout, share)
            for rollout, share in zip(self._rollouts[1:], shares[1:], strict=True)
            if self._pool is not None and share.size
        ]
        self._roll_out_share(self._rollouts[0], shares[0])
        for future in waiting:
            future.result()

    def _roll_out_share(self, rollout: mujoco.rollout.Rollout, share: np.ndarray) -> None:
        """Make one control step in some environments, one after the other."""
        for i in share:
            rollout.rollout(
                [self._models[i]],
                [self._datas[i]],
                self._state[i],
                self._control[i],
                control_spec=_CONTROL,
                skip_checks=True,
                nstep=self._world.frame_skip,
                initial_warmstart=self._warm[i],
                state=self._states[i],
                sensordata=self._sensors[i],
            )
            self._warm[i] = self._datas[i].qacc_warmstart

    def _positions(self) -> tuple[np.ndarray, np.ndarray]:
        nq, nv = self._world.nominal.nq, self._world.nominal.nv
        state = self._state[:, 0]
        return state[:, 1 : 1 + nq].copy(), state[:, 1 + nq : 1 + nq + nv].copy()

    def _robot_state(self) -> RobotState:
        return RobotState(*self._positions(), self._velocity.copy())

    def _observe(self) -> np.ndarray:
        return self._world.observe(self._robot_state())

    def close_extras(self, **kwargs: Any) -> None:
        """Stop the threads."""
        if self._pool is not None:
            self._pool.shutdown()
        for rollout in self._rollouts:
            rollout.close()
