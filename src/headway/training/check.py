"""The contract between an environment and its Task, looked at within seconds."""

import dataclasses
import itertools
import re
from collections.abc import Iterator
from contextlib import closing, suppress
from typing import Any, Literal

import jax
import jax.numpy as jnp
import numpy as np

from headway.config import Config, override
from headway.data import Trajectory
from headway.errors import BadEnvironmentError, HeadwayError, did_you_mean, one_line
from headway.models.compilation import prepare_jax
from headway.task import EnvSpec, Task, name_spec
from headway.training.collect import Episode, random_policy, run_episodes
from headway.training.environments import Environments
from headway.training.methods import make_config

TRANSITIONS = 200  # of one long episode, and about as many of short ones under all physics
LONGEST = 500  # steps in which a sim_param must show
MOST = 8  # values of a sim_param in a group that are tried
BIG = 1000.0  # below, float32 resolves what happens in a step
_REASONS = (
    (jax.errors.TracerBoolConversionError, "an `if`, `and` or `max` on numbers; use jnp.where"),
    (jax.errors.TracerArrayConversionError, "a call of NumPy; use jax.numpy"),
    (jax.errors.ConcretizationTypeError, "float(), int() or math; use jax.numpy"),
)


@dataclasses.dataclass(frozen=True)
class Finding:
    """One thing in which an environment and its Task were looked at."""

    name: str
    """The thing."""
    status: Literal["ok", "fault", "remark"]
    """A fault makes a run wrong; a remark does not."""
    text: str
    """Why, and what to do."""


def check(env: str | EnvSpec) -> list[Finding]:
    """Compare an environment with its Task, in random transitions under physics of every group.

    Before an environment of your own is trained on, `headway.train` does the same.

    Args:
        env: Short name or id of an environment, or an EnvSpec, which is registered by its name.

    Returns:
        The rows of the table of `headway check ENV`.

    Raises:
        UnknownNameError: No such environment.
        ConfigError: The EnvSpec has the name of a built-in environment.
    """
    prepare_jax()
    return list(findings(make_config(name_spec(env))))


def refuse_faults(config: Config) -> None:
    """Check the environment of a run that is about to be trained.

    Raises:
        BadEnvironmentError: There is a fault.
    """
    faults = [finding for finding in findings(config) if finding.status == "fault"]
    if faults:
        more = f" {len(faults) - 1} more." if faults[1:] else ""
        raise BadEnvironmentError(
            f"{config.env} and its Task, {faults[0].name}: {faults[0].text}{more} `headway check"
            f" {config.env}` or headway.check shows all; --collection.no-check goes on anyway."
        )


def findings(config: Config) -> Iterator[Finding]:
    """Look at the environment of a run; nothing is stepped before the Task can be traced."""
    try:
        environments = _environments(config)
    except Exception as error:  # whatever the environment does while it is made
        text = one_line(error)
        if not isinstance(error, HeadwayError):
            text = f"Making it raised {type(error).__name__}: {text}"
        yield Finding("environment", "fault", text)
        return
    with closing(environments):
        found = [_finding("action bounds", _bounds(environments))]
        if found[0].status == "ok":
            found += method_findings(environments.task)
        yield from found
        if any(finding.status == "fault" for finding in found):
            yield Finding("transitions", "remark", "Not looked at before this is mended.")
            return
        try:
            yield from _Trials(environments).findings(config.collection.max_bad_episodes)
        except HeadwayError as error:
            yield Finding("transitions", "fault", str(error))


def _environments(config: Config) -> Environments:
    """Two environments, so that what they share is noticed; or one, where no more can be made."""
    name = "collection.num_episodes"
    with suppress(Exception):
        return Environments.make(override(config, {name: min(2, config.collection.num_episodes)}))
    return Environments.make(override(config, {name: 1}))


def _finding(name: str, fault: str) -> Finding:
    return Finding(name, "fault" if fault else "ok", fault)


def _bounds(environments: Environments) -> str:
    """Say how bounds that the Task states differ from the environment's, if they do."""
    task, spaces = environments.task, environments.vector.spaces
    mine = np.array([task.action_low, task.action_high])
    theirs = np.array([spaces.action_low, spaces.action_high])
    if np.isclose(mine, np.where(np.isfinite(theirs), theirs, mine), rtol=1e-6).all():
        return ""
    text = f"action_low is {task.action_low} and action_high {task.action_high}, allowed: the"
    return f"{text} environment's bounds, {_short(theirs[0])} and {_short(theirs[1])}."


def method_findings(task: Task) -> Iterator[Finding]:
    """Trace the methods of a Task for 6 transitions."""
    rng = np.random.default_rng(0)
    obs, next_obs = jnp.asarray(rng.normal(size=(2, 6, task.obs_size)), jnp.float32)
    action = jnp.asarray(rng.uniform(-1, 1, (6, task.action_size)), jnp.float32)
    action = task.scale_action(action)
    row: tuple[int, ...] = (task.obs_size,)
    for name, shape, *rows in (
        ("reward", (), obs, action, next_obs),
        ("terminated", (), obs, action, next_obs),
        ("preprocess", None, obs),
        ("target", row, obs, next_obs),
        ("postprocess", row, obs, next_obs),
    ):
        if name == "reward" and not task.has_reward:
            text = "There is none: the model learns reward and end from the environment's."
            yield Finding("Task.reward", "remark", text)
            continue
        yield _finding(f"Task.{name}", _traced(task, name, shape, rows))


def _traced(task: Task, name: str, shape: tuple[int, ...] | None, rows: list[Any]) -> str:
    """Say what is wrong with a method of a Task, if anything is.

    Args:
        task: The Task.
        name: Of the method.
        shape: Of its result for one transition; None for a row of any size.
        rows: Its arguments for 6 transitions.
    """
    method = getattr(task, name)

    def both(*rows):
        return jax.vmap(method)(*rows), jnp.asarray(method(*(x.reshape(3, 2, -1) for x in rows)))

    try:
        single, batch = jax.jit(both)(*rows)
    except Exception as error:  # whatever the method does
        text = f"{type(error).__name__}: {one_line(error, 200)}"
        text = next((words for kind, words in _REASONS if isinstance(error, kind)), text)
        return f"JAX cannot trace it with leading axes: {text}."
    got = single.shape[1:]
    if len(got) != 1 if shape is None else got != shape:
        allowed = "a row of numbers" if shape is None else shape
        text = f"It returns shape {got} for one transition, allowed: {allowed}; take"
        return f"{text} a number by [..., 0], several by [..., :1]."
    same = batch.shape == (3, 2, *got)
    if not (same and np.allclose(batch.reshape(6, *got), single, 1e-4, 1e-4, equal_nan=True)):
        text = f"It returns shape {batch.shape} or other numbers for leading axes (3, 2) than"
        return f"{text} one by one; index with [..., i], and sum over axis=-1 only."
    if name == "terminated" and batch.dtype != bool:
        return f"It returns {batch.dtype}, allowed: bool, as next_obs[..., 0] > 1 is."
    return ""


@dataclasses.dataclass
class _Trials:
    """Random episodes under physics of every group, and what they show."""

    environments: Environments
    taken: list[Trajectory] = dataclasses.field(default_factory=list)
    raw: list[np.ndarray] = dataclasses.field(default_factory=list)
    """Their observations in the environment's own type, without the last one."""
    broken: list[str] = dataclasses.field(default_factory=list)
    """Why the other episodes are left out."""
    told: dict[str, list[tuple[Any, Any]]] = dataclasses.field(default_factory=dict)
    """Values asked for, and what `reset` told, by name of the parameter."""

    def act(self, *episodes: Episode, steps: int) -> list[np.ndarray | None]:
        """Run episodes with equal actions, side by side; their observations, or None for broken."""
        seen: list[np.ndarray | None] = []
        environments = dataclasses.replace(self.environments, episode_length=steps)
        size = environments.vector.num_envs
        for start in range(0, len(episodes), size):
            batch = episodes[start : start + size]
            random, raw = random_policy(environments, np.random.default_rng(batch[0].seed)), []

            def policy(obs, random=random, raw=raw):
                raw.append(obs.astype(np.float64))
                choice = random(obs)
                return choice._replace(action=np.repeat(choice.action[:1], len(obs), 0))

            rollout = run_episodes(environments, batch, policy)
            self.broken += rollout.invalid.values()
            told = getattr(environments.vector, "told", [one.sim_params for one in batch])
            for row, episode in enumerate(batch):
                found = rollout.episodes.get(row)
                seen.append(None if found is None else found.obs)
                if found is not None:
                    for name, value in told[row].items():
                        self.told.setdefault(name, []).append((episode.sim_params.get(name), value))
                    self.taken.append(found)
                    self.raw.append(np.array(raw)[: len(found), row])
        return seen

    def findings(self, max_broken: int) -> Iterator[Finding]:
        """Look at everything; so many episodes may break."""
        import gymnasium  # a controller is loaded without it

        for env in getattr(self.environments.vector, "envs", ())[:1]:
            if isinstance(env, gymnasium.Env):  # and not in a process of its own
                yield from _wrappers(env)
        sets = self.environments.sim_params
        steps = max(10, TRANSITIONS // (2 * len(sets.group_names) * len(sets.names)))
        first, last = Episode(sets.group("train")[0], 0), Episode(sets.group("train")[-1], 1)
        (before,) = self.act(first, steps=TRANSITIONS)
        params = [self.sim_param(name, steps) for name in sets.names]
        after, *_ = self.act(first, last, steps=steps)
        same = before is None or after is None
        if before is not None and after is not None and len(before[: steps + 1]) == len(after):
            same = np.allclose(before[: len(after)], after)
        text = "The same seed, sim_params and actions gave another episode than before; draw from"
        text += " self.np_random after super().reset(seed=seed), and let nothing stay of others."
        yield from (_finding("repeats", "" if same else text), *params)
        if self.broken:
            text = f"{len(self.broken)} broke, allowed: {max_broken} (collection.max_bad_episodes);"
            fault = not self.taken or len(self.broken) > max_broken
            text += f" the first: {self.broken[0]}."
            yield Finding("episodes", "fault" if fault else "remark", text)
        if self.taken:
            yield from compared(self.environments.task, self.taken)
            yield _finding("numbers", _unresolved(self.raw))

    def sim_param(self, name: str, steps: int) -> Finding:
        """Say whether a parameter changes observations in every group, and what `reset` told."""
        sets = self.environments.sim_params
        known = {row[name] for group in sets.group_names for row in sets.group(group)}
        if len(known) == 1:
            return Finding(name, "remark", "It has one value, so nothing shows that it is applied.")
        for seed, group in enumerate(sets.group_names):
            rows = sets.group(group)
            values = sorted({row[name] for row in rows})
            if len(values) == 1:  # the nearest one, so that a range that is clipped is noticed
                others = known - {*values}
                values.append(min(others, key=lambda value: abs(value - values[0])))
            values = values[:: -(-len(values) // MOST)] + values[-1:] * (len(values) > MOST)
            physics = [rows[0] | {name: value} for value in values]
            seen = self.act(*(Episode(one, seed) for one in physics), steps=steps)
            for two, pair in zip(*map(itertools.pairwise, (physics, seen)), strict=True):
                if _equal(*pair) and all(
                    _equal(*self.act(*(Episode(one, seed + more) for one in two), steps=LONGEST))
                    for more in (1, 2)
                ):
                    text = f"It changes no observation in group {group}, be it {two[0][name]:g} or"
                    text += f" {two[1][name]:g}; see that `reset` applies options['sim_params'] by"
                    text += " this name, that no wrapper drops the options, and that environments"
                    text += " do not share what it sets."
                    hint = did_you_mean(name, {*self.told} - {*sets.names})
                    return Finding(name, "fault", text + hint)
        for asked, told in self.told.get(name, ()):
            if not np.isclose(asked, told, rtol=1e-5):
                return _finding(name, f"Asked for {asked:g}, info['sim_params'] says {told:g}.")
        if name not in self.told:
            return Finding(name, "remark", "info['sim_params'] does not say what was applied.")
        return _finding(name, "")


def _equal(one: np.ndarray | None, two: np.ndarray | None) -> bool:
    return one is not None and two is not None and np.array_equal(one, two)


def compared(task: Task, taken: list[Trajectory]) -> Iterator[Finding]:
    """Compare the Task's numbers with the environment's."""
    ended = np.concatenate([np.arange(1, len(t) + 1) == len(t) * t.terminated for t in taken])
    rows = [(t.obs[:-1], t.action, t.obs[1:], t.reward) for t in taken]
    obs, action, next_obs, paid = map(np.concatenate, zip(*rows, strict=True))
    action = np.asarray(task.scale_action(jnp.asarray(action)))
    physics = [dict(t.sim_params) for t in taken for _ in range(len(t))]

    @jax.jit
    def numbers(obs, action, next_obs):
        rows, back = (obs, action, next_obs), task.postprocess(obs, task.target(obs, next_obs))
        reward = task.reward(*rows) if task.has_reward else obs[:, 0]
        return reward, task.terminated(*rows), back, task.preprocess(obs)

    reward, ends, back, features = map(np.asarray, numbers(obs, action, next_obs))
    # What the last bit of an observation decides is nobody's fault.
    nudged = np.nextafter(obs, np.float32(np.inf)), action, np.nextafter(next_obs, -np.float32(1e9))
    other_reward, other_ends, *_ = numbers(*nudged)
    rounding = 8 * np.abs(other_reward - reward)
    size = 1e-3 * np.maximum(np.abs(paid), np.median(np.abs(paid))) + 1e-9
    scale = 1e-4 * np.maximum(np.abs(obs), np.abs(next_obs)).max(0) + 1e-6
    finite = np.isfinite(features).all(1)
    for name, error, mine, theirs in (
        ("reward", np.abs(reward - paid) / (size + rounding), reward, paid),
        ("terminated", 2.0 * ((ends != ended) & (other_ends != ended)), ends, ended),
        ("preprocess", 2.0 * ~finite, features, len(obs) * ["finite"]),
        ("postprocess", (np.abs(back - next_obs) / scale).max(1), back, next_obs),
    ):
        if not task.has_reward and name in ("reward", "terminated"):
            continue
        bad, row = ~(error <= 1), np.argmax(np.nan_to_num(error, nan=np.inf))  # NaN is bad
        text = f"Task.{name} is {_short(mine[row])}, allowed: {_short(theirs[row])} as in the"
        text += f" environment; so in {bad.sum()} of {len(obs)} transitions, worst at obs"
        text += f" {_short(obs[row])}, action {_short(action[row])}, next_obs"
        text += f" {_short(next_obs[row])} under {physics[row]}."
        if not np.isfinite(mine[row]).all():
            text = f"Not finite: {text}"
        yield _finding(name, text if bad.any() else "")


def _unresolved(raw: list[np.ndarray]) -> str:
    """Say which observation changes less in a step than float32, of all models, resolves."""
    size = np.abs(np.concatenate(raw)).max(0).astype(np.float32)
    change = np.concatenate([np.zeros((1, len(size))), *(np.abs(np.diff(o, axis=0)) for o in raw)])
    change, finest = change.mean(0), np.spacing(size)
    for i in np.flatnonzero((size > BIG) & (change > 0) & (change < 16 * finest)):
        text = f"obs[{i}] is up to {size[i]:.3g} and changes by {change[i]:.2g} in a step, of which"
        return f"{text} float32 resolves {finest[i]:.2g}; subtract a constant in a wrapper."
    return ""


def _wrappers(env: Any) -> Iterator[Finding]:
    """Name wrappers with running statistics; say whether physics can change in an episode."""
    found = re.findall(r"Normalize(?:Observation|Reward)", str(env))
    text = f"{' and '.join(found)} keep running statistics, so that equal numbers mean different"
    text += " things as a run goes on; leave them out, models normalise by themselves."
    yield _finding("wrappers", text if found else "")
    if not env.has_wrapper_attr("set_sim_params"):
        text = "There is no set_sim_params(values): physics stay during an episode."
        yield Finding("schedule", "remark", text)


def _short(numbers: Any) -> str:
    return np.array2string(np.asarray(numbers), precision=6, separator=", ", threshold=8)
