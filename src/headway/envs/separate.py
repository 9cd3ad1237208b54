"""Vector environments made of separate Gymnasium environments."""

import abc
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import gymnasium
import numpy as np
from gymnasium.utils import seeding
from gymnasium.vector import AutoresetMode

from headway.envs.processes.service import Service
from headway.envs.vector import HeadwayVectorEnv, Outcome
from headway.envs.world import SimParams
from headway.errors import BadEnvironmentError, BrokenEpisodeError, ConfigError
from headway.sim_params import SimParamSets

Spaces = tuple[gymnasium.Space, gymnasium.Space]
"""Of observations and of actions."""
Calls = Mapping[int, tuple[Any, ...]]
"""What each of some environments is called with."""


class SeparateVectorEnv(HeadwayVectorEnv):
    """Environments that know nothing of each other, whatever is behind them.

    Args:
        spaces: Those of each environment.
        sim_params: Draws the parameters that `reset` is not told; None leaves that to the
            environments, which must then return them in `info["sim_params"]`.
        autoreset_mode: What happens after the end of an episode.
        episode_length: Steps after which an episode is cut; None leaves it to the environments.

    Raises:
        ConfigError: There are none.
        BadEnvironmentError: Their spaces differ.
    """

    def __init__(
        self,
        spaces: Sequence[Spaces],
        sim_params: SimParamSets | None,
        autoreset_mode: AutoresetMode | str,
        episode_length: int | None,
    ):
        if not spaces:
            raise ConfigError("env_fns is empty, allowed: at least one.")
        super().__init__(len(spaces), spaces[0], autoreset_mode, episode_length)
        for own in spaces:
            self._check_spaces(own)
        self._sets = sim_params
        self._rngs = [seeding.np_random()[0] for _ in spaces]
        self._obs: list[Any] = [np.zeros(spaces[0][0].shape or ()) for _ in spaces]

    @abc.abstractmethod
    def _call(self, method: str, calls: Calls) -> dict[int, Any]:
        """Call a method of `Service` for some environments.

        Returns:
            What it returned, or a `BrokenEpisodeError`.
        """

    def _check_actions(self, actions: np.ndarray) -> np.ndarray:
        allowed = self.action_space.shape
        if allowed is not None and np.shape(actions) != allowed:
            raise ConfigError(
                f"actions have shape {np.shape(actions)}, allowed: {allowed}, an action for each"
                " environment."
            )
        return actions

    def _begin(
        self, chosen: np.ndarray, seeds: Sequence[int | None], requested: Sequence[SimParams]
    ) -> dict[int, SimParams | BrokenEpisodeError]:
        asked = {int(i): self._complete(int(i), seeds[i], requested[i]) for i in chosen}
        calls = {i: (seeds[i], {"sim_params": asked[i]} if asked[i] else None) for i in asked}
        begun: dict[int, SimParams | BrokenEpisodeError] = {}
        for i, found in self._call("reset", calls).items():
            if isinstance(found, BrokenEpisodeError):
                begun[i] = found
                continue
            obs, sim_params, *spaces = found
            self._check_spaces((spaces[0], spaces[1]))
            self._obs[i] = self._check_obs(obs)
            begun[i] = asked[i] | sim_params
        return begun

    def _complete(self, i: int, seed: int | None, requested: SimParams) -> SimParams:
        """Draw the parameters that were not requested, where that is ours to do."""
        if self._sets is None:
            return requested
        if seed is not None:
            self._rngs[i] = seeding.np_random(seed)[0]
        return self._sets.sample(self._rngs[i]) | requested

    def _advance(self, active: np.ndarray, actions: np.ndarray) -> Outcome:
        found = self._call("step", {int(i): (actions[i],) for i in active})
        rewards, terminated, truncated = np.zeros(len(active)), [], []
        broken = {i: str(e) for i, e in found.items() if isinstance(e, BrokenEpisodeError)}
        for row, i in enumerate(active):
            if i in broken:
                ends = cut = False
            else:
                obs, reward, ends, cut = found[i]
                self._obs[i] = self._check_obs(obs)
                rewards[row] = _number(reward)
            terminated.append(bool(ends))
            truncated.append(bool(cut))
        return Outcome(rewards, np.array(terminated), np.array(truncated), broken)

    def _change(self, i: int, changed: SimParams) -> None:
        found = self._call("change", {i: (changed,)})[i]
        if isinstance(found, BrokenEpisodeError):
            raise found
        if not found:
            raise ConfigError(
                "schedule was given, but the environment has no method set_sim_params(values); add"
                " one, or leave the schedule out."
            )

    def _check_spaces(self, spaces: Spaces) -> None:
        allowed = self.single_observation_space, self.single_action_space
        if spaces != allowed:
            raise BadEnvironmentError(
                f"an environment has the observation and action space {spaces}, allowed:"
                f" {allowed}, as its neighbours and in every episode; correct the environment."
            )

    def _check_obs(self, obs: Any) -> np.ndarray:
        allowed = self.single_observation_space.shape
        if np.shape(obs) != allowed:
            raise BadEnvironmentError(
                f"an environment returned obs of shape {np.shape(obs)}, allowed: {allowed}, as"
                " its observation_space says; correct the environment."
            )
        return np.asarray(obs)

    def _observe(self) -> np.ndarray:
        return np.stack(self._obs)


class SequentialVectorEnv(SeparateVectorEnv):
    """Any Gymnasium environments, stepped one after the other.

    For environments of your own: they must take `options={"sim_params": {name: value}}` in
    `reset`, end no step with NaN, and share their spaces.

    Args:
        env_fns: Make the environments.
        sim_params: Draws the parameters that `reset` is not told; None leaves that to the
            environments, which must then return them in `info["sim_params"]`.
        autoreset_mode: What happens after the end of an episode.
        episode_length: Steps after which an episode is cut; None leaves it to the environments.
    """

    def __init__(
        self,
        env_fns: Sequence[Callable[[], gymnasium.Env]],
        *,
        sim_params: SimParamSets | None = None,
        autoreset_mode: AutoresetMode | str = AutoresetMode.NEXT_STEP,
        episode_length: int | None = None,
    ):
        self.envs = [make() for make in env_fns]
        self._services = [Service(env) for env in self.envs]
        spaces = [(env.observation_space, env.action_space) for env in self.envs]
        super().__init__(spaces, sim_params, autoreset_mode, episode_length)

    def _call(self, method: str, calls: Calls) -> dict[int, Any]:
        found: dict[int, Any] = {}
        for i, given in calls.items():
            try:
                found[i] = getattr(self._services[i], method)(*given)
            except BrokenEpisodeError as error:
                found[i] = error
        return found

    def close_extras(self, **kwargs: Any) -> None:
        """Close the environments."""
        for env in self.envs:
            env.close()


def _number(reward: Any) -> float:
    try:
        return float(reward)
    except (TypeError, ValueError):
        raise BadEnvironmentError(
            f"an environment returned the reward {reward!r}, allowed: a number; correct the"
            " environment."
        ) from None
