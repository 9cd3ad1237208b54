"""What is said of an environment that does not keep its contract with its Task."""

import json
import re
import sys

import equinox as eqx
import gymnasium
import jax.numpy as jnp
import numpy as np
import pytest
from gymnasium.wrappers import NormalizeObservation

import headway
from headway import task
from headway.cli import main
from headway.errors import BadEnvironmentError, BrokenEpisodeError, RunError

SETS = headway.SimParamSets({"mass": (0.5, 2.0)}, {"heavy": {"mass": (4.0,)}})


class Cart(gymnasium.Env):
    """Position and velocity of a cart whose mass is hidden; every argument is a fault."""

    observation_space = gymnasium.spaces.Box(-np.inf, np.inf, (2,), np.float64)
    action_space = gymnasium.spaces.Box(-3, 3, (1,), np.float64)

    resets = 0

    def __init__(self, deaf=False, lies=0.0, unseeded=0.0, offset=0.0, ends=np.inf, lost=np.inf):
        self.deaf, self.lies, self.unseeded, self.ends, self.lost = deaf, lies, unseeded, ends, lost
        self.offset = np.array([offset, 0.0])

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.steps, self.resets = 0, self.resets + 1
        self.mass = 1.0 if self.deaf else options["sim_params"]["mass"]
        if self.mass > self.lost:
            raise BrokenEpisodeError("too heavy")
        unseeded = np.random.default_rng().uniform(size=2)
        self.state = self.np_random.uniform(-1, 1, 2) + max(self.unseeded, 0) * unseeded
        told = {} if self.deaf else {"sim_params": {"mass": self.mass + self.lies}}
        return self.state + self.offset, told

    def step(self, action):
        velocity = self.state[1] + 0.1 * float(action[0]) / self.mass
        self.state = np.array([self.state[0] + 0.1 * velocity, velocity])
        seen = self.state + self.offset
        seen[1] += np.nan if abs(velocity) > self.lost else 0.0
        self.steps += 1
        cut = self.unseeded < 0 and self.steps > 20 // self.resets
        return seen, -float(seen[0] ** 2), bool(abs(velocity) > self.ends), cut, {}


class CartTask(headway.Task):
    obs_size = 2
    action_size = 1
    action_low = (-3.0,)
    action_high = (3.0,)

    def reward(self, obs, action, next_obs):
        return -jnp.square(next_obs[..., 0])


def changed(**methods):
    """The Task with other methods or bounds."""
    return type("Changed", (CartTask,), methods)


@pytest.fixture
def cart(monkeypatch):
    """Registers a cart with a fault, and returns its spec."""
    monkeypatch.setattr(task, "_registered", {})

    def make(make_task=CartTask, entry=Cart, sets=SETS, **fault):
        gymnasium.registry.pop("own/Cart-v0", None)
        gymnasium.register("own/Cart-v0", entry, kwargs=fault)
        own = {"name": "cart", "env_id": "own/Cart-v0", "make_task": make_task}
        spec = headway.EnvSpec(**own, sim_params=sets, episode_length=20)
        headway.register(spec)
        return spec

    yield make
    gymnasium.registry.pop("own/Cart-v0", None)


MISSPELT = headway.SimParamSets({"mass": (0.5, 2.0), "mas": (1.0, 2.0)})
TASKS = [
    ({"action_high": (np.inf,)}, "environment", "finite bounds"),
    ({"action_low": (3.0,), "action_high": (-3.0,)}, "environment", "the lower one first"),
    ({"action_high": (1.0,)}, "action bounds", r"the environment's bounds, \[-3.\] and \[3.\]"),
    ({"reward": lambda s, o, a, n: 1.0 if n[..., 0] > 0 else 0.0}, "Task.reward", "jnp.where"),
    ({"reward": lambda s, o, a, n: np.sqrt(n[..., 0])}, "Task.reward", "call of NumPy"),
    ({"reward": lambda s, o, a, n: float(n[..., 0])}, "Task.reward", r"float\(\)"),
    ({"reward": lambda s, o, a, n: n[..., :1]}, "Task.reward", r"shape \(1,\) for one"),
    ({"reward": lambda s, o, a, n: -jnp.square(n[..., 0]).mean()}, "Task.reward", "leading axes"),
    ({"reward": lambda s, o, a, n: n[..., 0]}, "reward", "worst at obs .* under {'mass'"),
    ({"reward": lambda s, o, a, n: jnp.log(-1 - n[..., 0] ** 2)}, "reward", "Not finite"),
    ({"terminated": lambda s, o, a, n: n[..., 0]}, "Task.terminated", "allowed: bool"),
    ({"terminated": lambda s, o, a, n: n[..., 1] > 0.5}, "terminated", "True, allowed: False"),
    ({"target": lambda s, o, n: o - n}, "postprocess", "transitions"),
    ({"preprocess": lambda s, o: o / 0}, "preprocess", "Not finite"),
    ({"obs_size": 3}, "environment", "obs"),
]
ENVS = [
    ({"deaf": True}, "mass", "changes no observation in group train"),
    ({"lies": 1.0}, "mass", r"Asked for 0.5, info\['sim_params'\] says 1.5"),
    ({"sets": MISSPELT}, "mas", "changes no observation"),
    ({"unseeded": 0.1}, "repeats", "self.np_random"),
    ({"unseeded": -1}, "repeats", "gave another episode"),  # it has another length
    ({"offset": 4e6}, "numbers", r"obs\[0\] is up to 4e\+06"),
    ({"ends": 0.5}, "terminated", "False, allowed: True"),
    ({"lost": 0.5}, "episodes", "allowed: 1 .*returned a non-finite obs"),
    ({"oops": 1}, "environment", "raised TypeError"),
    ({"entry": lambda: NormalizeObservation(Cart())}, "wrappers", "NormalizeObservation keep"),
]
FAULTS = [*((changed(**task), {}, *says) for task, *says in TASKS), *((CartTask, *e) for e in ENVS)]


@pytest.mark.parametrize(("make_task", "fault", "name", "says"), FAULTS)
def test_every_fault_is_named(make_task, fault, name, says, cart):
    found = headway.check(cart(make_task, **fault))
    faults = {row.name: row.text for row in found if row.status == "fault"}
    assert re.search(says, faults[name])
    assert "\n" not in faults[name]


def test_the_command_exits_1_where_something_is_wrong(cart, capsys):
    cart()
    assert main(["check", "cart", "--json"]) == 0
    found = {row["name"]: row["status"] for row in json.loads(capsys.readouterr().out)}
    assert found.pop("schedule") == "remark"
    assert {*found.values()} == {"ok"}
    assert {*found} > {"action bounds", "Task.reward", "reward", "repeats", "mass", "numbers"}
    cart(lies=1.0)
    assert main(["check", "cart"]) == 1
    assert re.search(r"✗ +mass +Asked for 0.5", capsys.readouterr().out)


def random_run(path, **settings):
    return headway.train("cart", method="random", preset="smoke", run_dir=path, settings=settings)


@pytest.mark.parametrize("processes", [True, False])
def test_a_fault_stops_before_anything_is_written(processes, cart, tmp_path):
    cart(changed(reward=lambda self, o, a, n: n[..., 0]), entry="test_check:Cart", lies=1.0)
    with pytest.raises(BadEnvironmentError, match=r"cart and its Task, mass: .* 1 more\. `headway"):
        random_run(tmp_path / "run", **{"collection.env_processes": processes})
    assert not (tmp_path / "run").exists()
    random_run(tmp_path / "run", **{"collection.check": False})
    assert (tmp_path / "run").exists()


def test_what_a_lost_episode_told_is_not_compared(cart):
    found = headway.check(cart(lost=3.0))  # the heavy ones
    assert [row.name for row in found if row.status == "remark"] == ["schedule", "episodes"]
    assert not [row for row in found if row.status == "fault"]


class GoalTask(CartTask):
    goal: object = 0.0
    tool: object = eqx.field(static=True, default_factory=object)  # another one each time


def test_a_run_of_another_environment_is_refused(cart, tmp_path, monkeypatch):
    """Whatever of it changed: the Task, the physics, the class or its source."""
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.delitem(sys.modules, "edited_cart", raising=False)
    source = "import test_check, edited_gain\nclass Cart(test_check.Cart): gain = edited_gain.GAIN"
    (tmp_path / "edited_cart.py").write_text(source)
    module = tmp_path / "edited_gain.py"
    module.write_text("GAIN = 1\n")
    cart(GoalTask, entry="edited_cart:Cart")
    path = random_run(tmp_path / "run").path
    other = headway.SimParamSets({"mass": (1.0, 3.0)})
    for words, changes in (
        (r"task\.goal: '0\.0' -> '1\.0'", {"make_task": lambda: GoalTask(1.0)}),
        (r"sim_params\.train\.mass: \[0\.5, 2\.0\] -> \[1\.0, 3\.0\]", {"sets": other}),
        (r"task\.goal: .* -> .*float64\[99\] ", {"make_task": lambda: GoalTask(np.zeros(99))}),
        (r"environment: 'edited_cart\.Cart' -> 'test_check\.Cart'", {"entry": Cart}),
        (r"environment: .* -> .*Cart{'offset': 1\.0}", {"offset": 1.0}),
    ):
        cart(**{"make_task": GoalTask, "entry": "edited_cart:Cart", **changes})
        with pytest.raises(RunError, match=words):
            random_run(path)
    cart(GoalTask, entry="edited_cart:Cart")
    module.write_text(module.read_text().replace("1", "2"))
    with pytest.raises(RunError, match=r"source of edited_gain changed: edited_gain\.py"):
        random_run(path)
    with pytest.warns(UserWarning, match="source of edited_gain changed"):
        headway.evaluate(path, groups=["heavy"])
    random_run(path, **{"collection.check": False})
