# pyright: reportAttributeAccessIssue=false
# (the names compiled into mujoco have no stubs)

"""Physics by name for MuJoCo environments of Gymnasium and, through Shimmy, of dm_control."""

import copy
import re
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import gymnasium
import numpy as np

from headway.errors import BrokenEpisodeError, ConfigError, shown, unknown_name
from headway.sim_params import SimParamSets, is_finite

_FIELDS = {
    "mass": ("body", "nbody", "body_mass", "body_inertia"),
    "friction": ("geom", "ngeom", "geom_friction"),
    "damping": ("joint", "njnt", "dof_damping", "dof_dampingpoly"),
    "gear": ("actuator", "nu", "actuator_gear"),
    "gain": ("actuator", "nu", "actuator_gainprm", "actuator_biasprm"),
}
"""Parts of the model that have a property, their number, and the fields that it scales."""
_DERIVED = (
    "body_subtreemass", "body_invweight0", "dof_M0", "dof_invweight0", "tendon_invweight0",
    "actuator_acc0", "cam_poscom0", "light_poscom0", "dof_armature",
)  # fmt: skip
"""What follows from masses (`mj_setConst`), and what locks a joint."""
_LOCKED = 1e8  # inertia of a locked joint, by its own


class MujocoPhysics(gymnasium.Wrapper):
    """Sets the physics of a MuJoCo environment, at `reset` and by `set_sim_params`.

    Every parameter is a factor, 1 being the unchanged environment: `mass` (with the inertia),
    `friction`, `damping`, `gear`, `gain` (of the actuators' forces) and `gravity`; of one part by
    name or number `body:NAME.mass`, `geom:NAME.friction`, `joint:NAME.damping`,
    `actuator:NAME.gear` and `actuator:NAME.gain`; and `joint:NAME.locked`, 0 or 1. Factors of a
    part and of the whole multiply. What `reset` is not told is as in the unchanged environment.

    Args:
        env: Its `unwrapped.model` is MuJoCo's, or that of its `physics`.
        sim_params: Names and values that will be set, to be refused now rather than then.

    Raises:
        ConfigError: The model has no such part or property, or a value is not allowed.
    """

    def __init__(self, env: gymnasium.Env, sim_params: SimParamSets | None = None):
        super().__init__(env)
        self._model = find_model(env)
        self._nominal = copy.copy(self._model)
        self._values: dict[str, float] = {}
        self._known: dict[str, tuple[str, Any]] = {"gravity": ("gravity", slice(None))}
        for what, (kind, size, *_) in _FIELDS.items():
            self._known[what] = (what, slice(None))
            for i in range(getattr(self._nominal, size)):
                rows = np.flatnonzero(self._nominal.dof_jntid == i) if kind == "joint" else [i]
                for name in {getattr(self._nominal, kind)(i).name or str(i), str(i)}:
                    self._known[f"{kind}:{name}.{what}"] = (what, rows)
                    if kind == "joint":
                        self._known[f"{kind}:{name}.locked"] = ("locked", rows)
        if sim_params is not None:
            for group in sim_params.group_names:
                for values in sim_params.spread(group, 99):
                    self._check(values)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Any, dict[str, Any]]:
        """Begin an episode under `options["sim_params"]`.

        Raises:
            ConfigError: A parameter or value is not allowed.
        """
        options = dict(options or {})
        self._set(self._check(options.pop("sim_params", None) or {}))
        obs, info = self.env.reset(seed=seed, options=options or None)
        return obs, {**info, "sim_params": dict(self._values)}

    def step(self, action: Any) -> tuple[Any, Any, bool, bool, dict[str, Any]]:
        """Make a step.

        Raises:
            BrokenEpisodeError: The simulation diverged; MuJoCo has quietly begun anew.
        """
        found, data = self.env.step(action), getattr(self.unwrapped, "data", None)
        if data is not None and (name := divergence(data)):  # dm_control looks by itself
            raise BrokenEpisodeError(f"the simulation diverged ({name})")
        return found

    def set_sim_params(self, values: Mapping[str, float]) -> None:
        """Change some parameters during an episode.

        Raises:
            ConfigError: A parameter or value is not allowed.
        """
        self._set(self._values | self._check(values))

    def _check(self, values: Mapping[str, float]) -> dict[str, float]:
        for name, value in values.items():
            if name not in self._known:
                parts = [one for one in self._known if not re.search(r":\d+\.", one)]
                raise unknown_name("sim_param", name, parts)
            fits, allowed = is_finite(value), "a finite factor"
            if name.endswith("locked"):
                fits, allowed = fits and value in (0, 1), "0 or 1"
            elif name.endswith("mass"):
                fits, allowed = fits and value > 0, "a finite factor above 0"
            elif name != "gravity":
                fits, allowed = fits and value >= 0, "a finite factor of at least 0"
            if not fits:
                raise ConfigError(f"sim_param {name} is {shown(value)}, allowed: {allowed}.")
        return dict(values)

    def _set(self, values: dict[str, float]) -> None:
        import mujoco

        if values == self._values:
            return
        new, self._values = copy.copy(self._nominal), values
        for name in sorted(values, key=lambda name: name.endswith("locked")):  # these come last
            value, (what, rows) = values[name], self._known[name]
            if what == "gravity":
                new.opt.gravity[:] *= value
            elif what == "locked" and value:
                # Its acceleration is next to none, and its velocity fades within a few steps.
                new.dof_armature[rows] = _LOCKED * new.dof_M0[rows]
                new.dof_damping[rows] = new.dof_armature[rows] / new.opt.timestep
            elif what != "locked":
                for field in _FIELDS[what][2:]:
                    if hasattr(new, field):  # which the version of MuJoCo decides
                        getattr(new, field)[rows] *= value
        inert = [name for name, value in values.items() if name.endswith("mass") and value != 1]
        if inert or (new.dof_armature != self._nominal.dof_armature).any():
            mujoco.mj_setConst(new, mujoco.MjData(new))
        self._model.opt.gravity[:] = new.opt.gravity
        scaled = [field for _, _, *fields in _FIELDS.values() for field in fields]
        for field in (*_DERIVED, *scaled):
            if hasattr(new, field):
                getattr(self._model, field)[...] = getattr(new, field)


def divergence(data: Any) -> str:
    """Name the numbers that broke a simulation since its reset as MuJoCo does; "" if none did.

    After such numbers it quietly starts over, and only counts them.
    """
    import mujoco

    counts, names = data.warning.number, ("BADQPOS", "BADQVEL", "BADQACC")
    kinds = [getattr(mujoco.mjtWarning, f"mjWARN_{name}").value for name in names]
    return next((name for name, kind in zip(names, kinds, strict=True) if counts[kind]), "")


def find_model(env: gymnasium.Env) -> Any:
    """The model of a MuJoCo environment of Gymnasium or Shimmy; None of any other."""
    for path in ("model", "physics.model.ptr"):
        found: Any = env.unwrapped
        for name in path.split("."):
            found = getattr(found, name, None)
        if type(found).__name__ == "MjModel" and type(found).__module__.startswith("mujoco"):
            return found
    return None


def adapted(make: Callable[..., Any], sim_params: SimParamSets | None, /, **keywords: Any) -> Any:
    """Make an environment; adapt what Headway can, and leave the rest as it is.

    Observations other than one row and pictures are flattened. Where MuJoCo runs below nothing
    but layers of Gymnasium and Shimmy, which know of no `sim_params`, they are `MujocoPhysics`.

    Args:
        make: Makes it.
        sim_params: See `MujocoPhysics`.
        keywords: For `make`.
    """
    env = make(**keywords)
    if not isinstance(env, gymnasium.Env):
        return env  # refused where it is used
    space = env.observation_space
    packages = {type(layer).__module__.partition(".")[0] for layer in _layers(env)}
    if len(space.shape or ()) != 1 and space.dtype != np.uint8 and space.is_np_flattenable:
        env = gymnasium.wrappers.FlattenObservation(env)
    if packages <= {"gymnasium", "shimmy"} and find_model(env) is not None:
        env = MujocoPhysics(env, sim_params)
    return env


def _layers(env: gymnasium.Env) -> list[gymnasium.Env]:
    """The wrappers, from the outside in, and what they wrap."""
    return [env, *(_layers(env.env) if isinstance(env, gymnasium.Wrapper) else [])]


def try_out(env: gymnasium.Env, sequences: Sequence[Any]) -> list[float]:
    """Sums of rewards that sequences of actions would earn; the environment stays where it is.

    Every sequence has a copy of it; copies of MuJoCo's model are not sound, so there the data and
    the attributes of all layers are put back instead.

    Args:
        env: The environment, some steps into an episode.
        sequences: Actions as `env.step` takes them. An episode that terminates earns no more; the
            sum of one that breaks is NaN.

    Raises:
        ConfigError: It cannot be copied.
    """
    model, attributes = find_model(env), [(vars(one), dict(vars(one))) for one in _layers(env)]
    try:
        tried = [copy.deepcopy(env) if model is None else env for _ in sequences]
        data = None if model is None else env.get_wrapper_attr("data")
        start = copy.copy(data)
    except Exception as error:  # whatever its parts raise
        raise ConfigError(
            f"{env} cannot be copied to try actions out ({error}), allowed: what copy.deepcopy"
            " takes, and Gymnasium's MuJoCo environments; choose another method than true-dynamics."
        ) from error
    found = []
    for one, actions in zip(tried, sequences, strict=True):
        found.append(0.0)
        try:
            for action in actions:
                _, reward, terminated, _, _ = one.step(action)
                found[-1] += float(reward)
                if terminated:
                    break
        except BrokenEpisodeError:
            found[-1] = np.nan
        if model is not None:
            import mujoco

            mujoco.mj_copyData(data, model, start)
            for now, before in attributes:
                now.update(before)
    return found
