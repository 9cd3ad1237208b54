"""A controller as one file that plans with JAX alone: its step as StableHLO, and a description.

The file is a zip archive. `description.json` says what goes in and out; `start.bin`, `step.bin` and
`applied.bin` are functions as `jax.export` serialises them; `flatbuffers/` is the package of that
name (Apache-2.0), without which JAX does not read them.
"""

import dataclasses
import hashlib
import io
import json
import zipfile
from collections.abc import Mapping
from importlib.metadata import version
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from headway.api import load
from headway.errors import ConfigError, needs
from headway.models.compilation import compiler_options
from headway.planning.agent import Agent, AgentState, open_loop, step
from headway.task import env_spec
from headway.training.files import check_target, named_leaves, write_bytes
from headway.training.run import Iteration, RunDir

FORMAT = 1
PLATFORMS = ("cpu", "cuda")
OUTCOMES = ("planned", "held", "none left")
PLANNED, HELD, NONE_LEFT = range(len(OUTCOMES))
# XLA has known it for years, but JAX does not promise that it will.
LAYOUTS = jax.export.DisabledSafetyCheck.custom_call("LayoutConstraint")

State = tuple[Array, ...]


def export(
    run_dir: str | Path,
    path: str | Path,
    *,
    iteration: Iteration = None,
    settings: Mapping[str, Any] | None = None,
) -> Path:
    """Write the controller of a run as one file that plans without Headway.

    Args:
        run_dir: The run directory.
        path: The file to write, such as `controller.headway`.
        iteration: As `load`.
        settings: As `load`: another planner than the run was trained with.

    Returns:
        The path.

    Raises:
        ConfigError: The run's agent cannot be exported, a package is missing, or as `load`.
        RunError: As `load`, or the file cannot be written.
        LimitError: The disk is full.
    """
    path = Path(path)
    check_target(path)
    needs("export", "flatbuffers")
    import flatbuffers

    controller = load(run_dir, iteration=iteration, settings=settings)
    robot, planner = Robot(controller.agent), controller.agent.planner
    spaces, number = robot.agent.task.spaces, jax.ShapeDtypeStruct((), jnp.int32)
    state = jax.eval_shape(robot.start, number, number)
    obs = jax.ShapeDtypeStruct((spaces.obs_size,), jnp.float32)
    action = jax.eval_shape(robot.step, state, obs)[1]
    codes = {}
    for function, *args in (
        (robot.start, number, number),
        (robot.step, state, obs),
        (robot.applied, state, action),
    ):
        lower = jax.export.export(jax.jit(function), platforms=PLATFORMS, disabled_checks=[LAYOUTS])
        codes[f"{function.__name__}.bin"] = bytes(lower(*args).serialize())
    run = RunDir(run_dir)
    config, number = run.config(), run.kept_iteration(iteration)
    origin = {name: getattr(config, name) for name in ("env", "method", "preset", "seed")}
    origin |= {"iteration": number, "timesteps": run.metrics()[number]["timesteps"]}
    about = {
        "format": FORMAT,
        "run": origin,
        "versions": {name: version(name) for name in ("headway", "jax", "jaxlib")},
        **dataclasses.asdict(spaces),
        "obs_names": env_spec(config.env).obs_names,
        "horizon": planner.horizon,
        "control_step": "one call is one step of the training environment",
        "platforms": PLATFORMS,
        "compiler_options": {jax.default_backend(): compiler_options(planner.precision)},
        "state": [name for name, _ in named_leaves(robot.begin(0, 0))] + ["steps_left"],
        "outcomes": OUTCOMES,
        "sha256": {name: hashlib.sha256(code).hexdigest() for name, code in codes.items()},
    }
    members = {"description.json": json.dumps(about, indent=2).encode(), **codes}
    for source in sorted(Path(flatbuffers.__file__).parent.glob("*.py")):
        members[f"flatbuffers/{source.name}"] = source.read_bytes()
    content = io.BytesIO()
    with zipfile.ZipFile(content, "w") as archive:
        for name, member in members.items():
            archive.writestr(zipfile.ZipInfo(name), member, zipfile.ZIP_DEFLATED)
    write_bytes(path, content.getvalue())
    return path


class Robot:
    """The controller of one robot as pure functions that `jax.jit` and `jax.export` take.

    A state is a tuple of arrays: those of the `AgentState`, and the steps for which the last plan
    can still be held. There is no deadline, and nobody looks whether observations are like the
    training data; else it acts as `Controller`.

    Args:
        agent: It plans.

    Raises:
        ConfigError: It acts at random, plans with a simulator, or is told the physics.
    """

    def __init__(self, agent: Agent):
        if agent.model is None or not agent.model.traceable or agent.sim_param_names:
            raise ConfigError(
                "the run acts at random, plans with a simulator or is told the true physics,"
                " allowed: a run whose model has learned all it knows, such as tmcl or pets."
            )
        self.agent = agent
        self._structure = jax.tree.structure(self.begin(0, 0))

    def start(self, seed: Int[Array, ""], episode: Int[Array, ""]) -> State:
        """The state at the beginning of an episode; the draws of each are its own."""
        return self._pack(self.begin(seed, episode), jnp.int32(0))

    def step(self, state: State, obs: Float[Array, " obs"]) -> tuple[State, Array, Array, Array]:
        """The next state, the action in the environment's units, the heads, and the outcome.

        The outcome is a number of `OUTCOMES`. With none left the action is NaN, or where actions
        are integers means nothing.
        """
        before, left = self._unpack(state)

        def plan() -> tuple[AgentState, Array]:
            after, decision = step(self.agent, before, obs[None])
            return after, decision.failures[0] >= self.agent.planner.num_iterations

        def hold() -> tuple[AgentState, Array]:
            return open_loop(self.agent, before), jnp.array(True)

        after, held = jax.lax.cond(jnp.isfinite(obs).all(), plan, hold)
        outcome = jnp.where(held, jnp.where(left > 0, HELD, NONE_LEFT), PLANNED)
        left = jnp.where(held, jnp.maximum(left - 1, 0), self.agent.planner.horizon - 1)
        after = after._replace(acted=after.acted & (outcome != NONE_LEFT))  # nothing to be applied
        heads = getattr(after.belief, "heads", jnp.zeros((1, 0), jnp.int32))[0]
        action = self._own_units(after.action[0], outcome == NONE_LEFT)
        return self._pack(after, left), action, heads, outcome

    def applied(self, state: State, action: Array) -> State:
        """The state after an action that is not the one `step` returned; NaN if it is not known."""
        before, left = self._unpack(state)
        own = action.astype(jnp.float32).ravel()
        known = jnp.isfinite(own).all()
        scaled = jnp.where(known, self.agent.task.unscale_action(own), before.action[0])
        return self._pack(before._replace(action=scaled[None], acted=before.acted & known), left)

    def begin(self, seed: Any, episode: Any) -> AgentState:
        """The agent's own state at the beginning of an episode."""
        return self.agent.init(1, key=jax.random.fold_in(jax.random.key(seed), episode))

    def _pack(self, state: AgentState, left: Array) -> State:
        return *jax.tree.leaves(state._replace(key=jax.random.key_data(state.key))), left

    def _unpack(self, state: State) -> tuple[AgentState, Array]:
        *leaves, left = state
        found: AgentState = jax.tree.unflatten(self._structure, leaves)
        return found._replace(key=jax.random.wrap_key_data(found.key)), left

    def _own_units(self, scaled: Float[Array, " scaled"], unknown: Array) -> Array:
        """`env_action` in 32 bits."""
        spaces = self.agent.task.spaces
        low, high = np.array(spaces.action_low), np.array(spaces.action_high)
        if spaces.action_kind == "box":  # rounded once where the bounds are opposite numbers
            own = np.float32((low + high) / 2) + np.float32((high - low) / 2) * scaled
        else:
            own = jnp.rint(self.agent.task.scale_action(scaled))
        own = jnp.clip(own, np.float32(low), np.float32(high)).reshape(spaces.action_shape)
        integers = np.issubdtype(spaces.action_dtype, np.integer)
        return own.astype(jnp.int32) if integers else jnp.where(unknown, jnp.nan, own)
