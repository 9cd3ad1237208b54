"""Models that change while they act, from the transitions of the present episode alone.

Each remembers something of every environment, and turns that into what a plan imagines with.
"""

from typing import Any, NamedTuple, Protocol, runtime_checkable

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from headway.models.adapted import ReluNet, Window, adapt
from headway.models.dynamics import Statistics, network_input
from headway.models.recurrent import CellState, RecurrentNet, next_cell
from headway.planning.heads import RecentTransitions
from headway.planning.imagination import Layer, over_rows, plan_layers
from headway.planning.optimizers import where_env
from headway.planning.returns import Dynamics
from headway.task import Task


class Transition(NamedTuple):
    """One step of every environment, and where it happened at all."""

    obs: Float[Array, "env obs"]
    """Before the step."""
    action: Float[Array, "env action"]
    """Scaled to [-1, 1]."""
    next_obs: Float[Array, "env obs"]
    """After the step."""
    happened: Bool[Array, " env"]
    """Where there was such a step; not at the beginning of an episode."""


@runtime_checkable
class AdaptiveModel(Protocol):
    """A model that learns from the present episode."""

    def start(self, num_envs: int) -> Any:
        """Know nothing of the episodes yet; arrays lead with the environments."""
        ...

    def remember(self, memory: Any, transition: Transition) -> Any:
        """Take in what just happened."""
        ...

    def dynamics(self, memory: Any, precision: str) -> Dynamics:
        """What a plan imagines with, given what is remembered."""
        ...


class GradientAdapted(eqx.Module):
    """GrBAL: one gradient step on the newest transitions, from the meta-learned weights.

    Until an episode has `length` transitions, the meta-learned weights themselves predict.
    """

    net: ReluNet
    statistics: Statistics
    task: Task
    length: int = eqx.field(static=True)
    rate: float = eqx.field(static=True)

    def start(self, num_envs: int) -> RecentTransitions:
        """See `AdaptiveModel.start`."""
        return RecentTransitions.empty(num_envs, self.length, self.task)

    def remember(self, memory: RecentTransitions, transition: Transition) -> RecentTransitions:
        """See `AdaptiveModel.remember`."""
        return memory.push(*transition)

    def adapted(self, memory: RecentTransitions) -> ReluNet:
        """The weights of every environment, leading with the environments."""
        recent = memory.obs, memory.action, memory.next_obs
        weight = jnp.ones(memory.obs.shape[:2])
        past = Window.of(self.task, self.statistics, recent, weight)
        nets = jax.vmap(lambda past: adapt(self.net, past, self.rate))(past)
        num_envs = len(memory.count)
        same = jax.tree.map(lambda x: jnp.broadcast_to(x, (num_envs, *x.shape)), self.net)
        return where_env(memory.count >= self.length, nets, same)

    def dynamics(self, memory: RecentTransitions, precision: str) -> "AdaptedDynamics":
        """See `AdaptiveModel.dynamics`."""
        net = self.adapted(memory)
        layers = plan_layers((*net.hidden, net.output), precision)
        return AdaptedDynamics(layers, self.statistics)


class OneNetwork(eqx.Module):
    """What a plan with a single network without variance has in common (see `Dynamics`)."""

    layers: tuple[Layer, ...]
    statistics: Statistics
    num_members = 1
    stochastic = False

    @property
    def widest(self) -> int:
        """See `Dynamics.widest`."""
        return max(layer.bias.shape[-1] for layer in self.layers)


class AdaptedDynamics(OneNetwork):
    """A plain network whose weights differ between environments."""

    @property
    def per_env(self) -> tuple[Layer, ...]:
        """See `Dynamics.per_env`."""
        return self.layers

    def of_env(self, part: tuple[Layer, ...]) -> "AdaptedDynamics":
        """See `Dynamics.of_env`."""
        return AdaptedDynamics(part, self.statistics)

    def start(self) -> tuple[()]:
        """See `Dynamics.start`."""
        return ()

    def step(
        self,
        task: Task,
        carry: tuple[()],
        obs: Float[Array, "1 obs particle candidate"],
        action: Float[Array, "1 action particle candidate"],
        noise: None,
    ) -> tuple[tuple[()], Float[Array, "1 obs particle candidate"]]:
        """See `Dynamics.step`."""
        del noise
        x = wide_input(task, self.statistics, obs, action)
        *hidden, output = self.layers
        for layer in hidden:
            x = jax.nn.relu(layer(x))
        return carry, next_observation(task, self.statistics, obs, output(x))


class Recurrent(eqx.Module):
    """ReBAL: a recurrent network, whose state is the memory of the episode."""

    net: RecurrentNet
    statistics: Statistics
    task: Task

    def start(self, num_envs: int) -> tuple[CellState, ...]:
        """See `AdaptiveModel.start`."""
        return self.net.start(num_envs)

    def remember(
        self, memory: tuple[CellState, ...], transition: Transition
    ) -> tuple[CellState, ...]:
        """See `AdaptiveModel.remember`; the state goes on by the action that was taken."""
        x = network_input(self.task, self.statistics, transition.obs, transition.action)
        return where_env(transition.happened, self.net(memory, x)[0], memory)

    def dynamics(self, memory: tuple[CellState, ...], precision: str) -> "RecurrentDynamics":
        """See `AdaptiveModel.dynamics`."""
        layers = plan_layers((*self.net.layers, self.net.output), precision)
        return RecurrentDynamics(layers, self.statistics, memory)


class RecurrentDynamics(OneNetwork):
    """A recurrent network whose state goes on with every imagined step."""

    state: tuple[CellState, ...]

    @property
    def per_env(self) -> tuple[CellState, ...]:
        """See `Dynamics.per_env`."""
        return self.state

    def of_env(self, part: tuple[CellState, ...]) -> "RecurrentDynamics":
        """See `Dynamics.of_env`."""
        return RecurrentDynamics(self.layers, self.statistics, part)

    def start(self) -> tuple[CellState, ...]:
        """See `Dynamics.start`."""
        return jax.tree.map(lambda x: x[None], self.state)

    def step(
        self,
        task: Task,
        carry: tuple[CellState, ...],
        obs: Float[Array, "1 obs particle candidate"],
        action: Float[Array, "1 action particle candidate"],
        noise: None,
    ) -> tuple[tuple[CellState, ...], Float[Array, "1 obs particle candidate"]]:
        """See `Dynamics.step`."""
        del noise
        x = wide_input(task, self.statistics, obs, action)
        *layers, output = self.layers
        states = []
        for layer, before in zip(layers, carry, strict=True):
            gates = layer(jnp.concatenate([x, before.hidden], axis=1))
            states.append(next_cell(before, gates, axis=1))
            x = states[-1].hidden
        return tuple(states), next_observation(task, self.statistics, obs, output(x))


def wide_input(
    task: Task,
    statistics: Statistics,
    obs: Float[Array, "1 obs particle candidate"],
    action: Float[Array, "1 action particle candidate"],
) -> Float[Array, "1 in particle candidate"]:
    """`network_input` in the layout of a plan."""

    def of_row(obs, action):
        return network_input(task, statistics, obs, action)

    return over_rows(of_row)(obs, action)


def next_observation(
    task: Task,
    statistics: Statistics,
    obs: Float[Array, "1 obs particle candidate"],
    normalized: Float[Array, "1 obs particle candidate"],
) -> Float[Array, "1 obs particle candidate"]:
    """Where a predicted, normalised `delta` leads."""
    delta = over_rows(statistics.delta.denormalize)(normalized)
    return over_rows(task.postprocess)(obs, delta)
