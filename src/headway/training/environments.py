"""The environments that a run acts in, and one line for whatever they raise."""

import contextlib
import dataclasses
from collections.abc import Iterator
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import UInt8

from headway.config import LARGEST, Config, differences
from headway.errors import BadEnvironmentError, HeadwayError, one_line, shown
from headway.sim_params import SimParamSets
from headway.spaces import Spaces
from headway.task import Task, env_options, episode_length, sim_param_sets, task_of

if TYPE_CHECKING:
    from headway.envs import HeadwayVectorEnv


@dataclasses.dataclass(frozen=True)
class Environments:
    """The vector environment that a run acts in, and its Task."""

    name: str
    """Short name of the environment."""
    task: Task
    vector: "HeadwayVectorEnv"
    sim_params: SimParamSets
    episode_length: int

    @classmethod
    def make(cls, config: Config, *, single: bool = False, film: bool = False) -> "Environments":
        """Make as many as a configuration runs side by side, or a single one in this process.

        One for a film can be drawn; it runs in a process of its own where the others do.

        Raises:
            BadEnvironmentError: It cannot be made, its spaces do not fit its Task or its run, or
                no plan is made in such spaces.
        """
        from headway import envs  # a controller is loaded without a simulator

        collection, sim_params = config.collection, sim_param_sets(config)
        apart, count = collection.env_processes and not single, collection.num_episodes
        if not config.model.learns:  # it only tests, and places without an episode cost as much
            count = min(count, config.evaluation.num_episodes * len(sim_params.group_names))
        with raising(config.env, "creation" + film * " with render_mode, to be filmed"):
            vector = envs.make_vec(
                config.env,
                1 if single or film else count,
                sim_params=sim_params,
                options=env_options(config),
                episode_length=episode_length(config),
                step_timeout_s=collection.step_timeout_s if apart else None,
                render_mode="rgb_array" if film else None,
            )
        try:
            task = _task_in(config, vector.spaces)
        except Exception:
            vector.close()
            raise
        return cls(config.env, task, vector, sim_params, episode_length(config))

    def frame(self) -> UInt8[np.ndarray, "height width 3"]:
        """Draw the first environment.

        Raises:
            BadEnvironmentError: It gave no picture.
        """
        image: Any = next(iter(self.vector.render() or ()), None)
        kind = getattr(image, "dtype", type(image).__name__)
        if kind != np.uint8 or image.ndim != 3:
            raise BadEnvironmentError(
                f"render() gave {kind}, allowed: an image of type uint8 and shape"
                " [height, width, 3], as with render_mode='rgb_array'."
            )
        return image

    def close(self) -> None:
        """Free what the environments hold, and end their processes."""
        with raising(self.name, "closing"):
            self.vector.close()


def _task_in(config: Config, read: Spaces) -> Task:
    """The Task of a run, told the spaces of its environment; what it states itself counts.

    Raises:
        BadEnvironmentError: They contradict each other, or actions are not bounded.
    """
    task = task_of(dataclasses.replace(config, spaces=read))
    low, high = tuple(task.action_low), tuple(task.action_high)
    stated = task.obs_size, task.action_size, len(low), len(high)
    found = read.obs_size, read.action_size, *2 * [len(read.action_low)]
    if stated != found:
        raise BadEnvironmentError(
            f"the Task of {config.env} states {stated} as obs_size, action_size and numbers of"
            f" bounds, but its environment has {found}; correct the Task, or let it state none."
        )
    width, whole = np.subtract(high, low), read.action_kind != "box"
    widest = LARGEST if whole else np.finfo(np.float32).max
    if not ((width + whole > 0) & (width <= widest)).all():
        raise BadEnvironmentError(
            f"the actions of {config.env} have action_low {shown(low)} and action_high"
            f" {shown(high)}, allowed: finite bounds, the lower one first; correct the space, or"
            " state both in the Task."
        )
    spaces = dataclasses.replace(read, action_low=low, action_high=high)
    told = dataclasses.replace(config, spaces=spaces)
    if config.spaces and (changed := differences(config, told)):
        raise BadEnvironmentError(
            f"{config.env} has other spaces than its run ({'; '.join(changed)}); bring them back,"
            " or train another run."
        )
    return task_of(told)


@contextlib.contextmanager
def raising(name: str, when: str) -> Iterator[None]:
    """Turn whatever the environment `name` raises into one line that says when.

    Raises:
        BadEnvironmentError: It raised.
    """
    try:
        yield
    except BadEnvironmentError as error:
        raise BadEnvironmentError(f"{name} at {when}: {error}") from error
    except HeadwayError:
        raise
    except Exception as error:
        raise BadEnvironmentError(
            f"{name} raised {type(error).__name__} at {when}: {one_line(error, 300)}; correct the"
            " environment, then the same command goes on."
        ) from error
