"""Heads that keep learning while they act: a Bayesian last layer for every episode.

What a head's mean misses is modelled as a linear function of the features φ that the head sees:
the backbone's output, the context and a 1. For every environment, member, head and dimension o,

    r_o = φᵀ w_o + ε,    w_o ~ N(0, σ_o² ρ R Rᵀ),    ε ~ N(0, σ_o² n),

where r is the normalised delta minus the head's mean, ρ, R and σ² come from the training data
(`prior`), and n is 1, or more for a transition that is doubted. The posterior
covariance is σ_o² P, and P depends on the features only, so the dimensions share it.

Every transition is one step of a Kalman filter, in closed form. The chosen head's posterior mean
is then added to its weights before the plan, so imagined rollouts cost nothing more.

Sources: Bayesian linear regression (Bishop, 2006, section 3.3); ALPaCA (Harrison et al., 2018);
Potter's square-root filter (Maybeck, 1979, section 7.3).
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from headway.data import Episodes
from headway.models.multi_headed import MultiHeadDynamics, Statistics, network_input
from headway.task import Task

BELIEVABLE = 100.0
"""Deviations of the training data's deltas; larger residuals of a head count as this large, and
a transition that no head finds smaller teaches nothing."""
MAX_FEATURES = 1e8
"""Squared norm of the features; larger ones teach nothing."""
NOISE_DOF = 1.0
"""Transitions that the training data's noise variance is worth in an episode."""
TINY = 1e-12


class Shape(NamedTuple):
    """How the prior is spread over the features: a correction's covariance is σ² ρ R Rᵀ."""

    root: Float[Array, "member feature feature"]
    """R."""
    inverse: Float[Array, "member feature feature"]
    """R⁻¹."""


class Prior(NamedTuple):
    """What an episode is expected to ask of the heads, per member."""

    ratio: Float[Array, " member"]
    """Prior variance of a weight over the variance of the noise (ρ); by foresight, all members
    have the same."""
    noise: Float[Array, "member obs"]
    """Variance of the noise in normalised units (σ²)."""
    shape: Shape | None = None
    """None where all weights are equally uncertain (R = I)."""

    @property
    def members(self) -> int:
        """Networks in the ensemble."""
        return self.ratio.shape[0]

    def root(self, size: int) -> Float[Array, "member size size"]:
        """Square root of the prior covariance in units of the noise variance, √ρ R."""
        shape = jnp.eye(size) if self.shape is None else self.shape.root
        return jnp.sqrt(self.ratio)[:, None, None] * shape


class Seen(NamedTuple):
    """Transitions as the heads see them, before anything is learned from them."""

    features: Float[Array, "env member feature"]
    """The backbone's output, the context and a 1."""
    residual: Float[Array, "env member head obs"]
    """The normalised delta minus each head's mean."""
    logvar: Float[Array, "env member head obs"] | None
    """The heads' own log-variance; None if they are deterministic."""

    @classmethod
    def through(
        cls,
        model: MultiHeadDynamics,
        task: Task,
        statistics: Statistics,
        transition: tuple[Float[Array, "env obs"], Float[Array, "env action"], Array],
        context: Float[Array, "member env context"] | None,
    ) -> "Seen":
        """Look at one transition per environment through a model.

        Args:
            model: The dynamics model.
            task: How observations enter and leave it.
            statistics: The normalisers in use.
            transition: Observations, actions in [-1, 1], next observations.
            context: The context vectors that the heads plan with.
        """
        obs, action, next_obs = transition
        net = model.forward_net
        x = network_input(task, statistics, obs, action)
        wide = jnp.broadcast_to(x, (model.num_members, *x.shape))
        head_input = net.head_input(wide, context)
        target = statistics.delta.normalize(task.target(obs, next_obs))
        mean, logvar = net.predict(head_input)
        if logvar is not None:
            logvar = logvar.transpose(2, 0, 1, 3)
        one = jnp.ones((*head_input.shape[:-1], 1))
        features = jnp.concatenate([head_input, one], axis=-1).transpose(1, 0, 2)
        residual = target - mean
        return cls(features, residual.transpose(2, 0, 1, 3), logvar)

    def believed(self, happened: Bool[Array, " env"]) -> "Seen":
        """What happened and can be true; the rest has features and residuals of zero.

        A head that alone is absurdly wrong keeps its member's other heads from nothing.
        """
        size = jnp.square(self.features).sum(-1)
        credible = (jnp.abs(self.residual) < BELIEVABLE).all(-1).any(-1)
        true = happened[:, None] & (size < MAX_FEATURES) & credible
        residual = jnp.nan_to_num(self.residual, nan=BELIEVABLE)
        residual = jnp.clip(residual, -BELIEVABLE, BELIEVABLE)
        return Seen(
            jnp.where(true[..., None], self.features, 0.0),
            jnp.where(true[..., None, None], residual, 0.0),
            self.logvar,
        )


def see_episode(
    model: MultiHeadDynamics,
    task: Task,
    statistics: Statistics,
    episodes: Episodes,
    row: int | Int[Array, ""],
    moments: Int[Array, " time"],
    history_length: int,
) -> Seen:
    """All transitions of an episode that can be true; what is `env` in `Seen` is time here.

    Args:
        model: The dynamics model.
        task: How observations enter and leave it.
        statistics: The normalisers in use.
        episodes: Padded episodes.
        row: Which of them.
        moments: For each transition, the step of whose past its context is made.
        history_length: Past transitions that a context is made of (K).
    """
    history = episodes.history(jnp.full_like(moments, row), moments, history_length)
    told = episodes.sim_params[row]
    told = jnp.broadcast_to(told, (len(moments), len(told)))
    history, told = jax.tree.map(
        lambda x: jnp.broadcast_to(x, (model.num_members, *x.shape)), (history, told)
    )
    context = model.context(history, statistics, told)
    obs = episodes.obs[row]
    transition = obs[:-1], episodes.action[row], obs[1:]
    happened = jnp.arange(len(obs) - 1) < episodes.length[row]
    return Seen.through(model, task, statistics, transition, context).believed(happened)


def heads_by_error(
    residual: Float[Array, "time member head obs"],
) -> Int[Array, "member head"]:
    """Heads in the order in which they explain an episode, by the summed squared error."""
    return jnp.argsort(jnp.square(residual).sum((0, 3)), axis=-1, stable=True)


class Observed(NamedTuple):
    """What the heads learn from: the newest transition of each environment."""

    features: Float[Array, "env member feature"]
    residual: Float[Array, "env member head obs"]
    noise: Float[Array, "env member group"]
    """Relative variance n of the noise, 1 unless the transition is doubted."""

    @property
    def learned_from(self) -> Float[Array, "env member"]:
        """1 where there is something to learn, else 0: the last feature of any transition is 1."""
        return self.features[..., -1]

    @classmethod
    def of(
        cls,
        seen: Seen,
        happened: Bool[Array, " env"],
    ) -> "Observed":
        """Keep what happened and can be true (`Seen.believed`).

        Args:
            seen: The transitions.
            happened: Where there was one.
        """
        features, residual, _ = seen.believed(happened)
        return cls(features, residual, jnp.ones((*features.shape[:-1], 1)))

    def noisier(self, more: Float[Array, "env member group"]) -> "Observed":
        """The same with more noise, so that it counts for less."""
        return self._replace(noise=self.noise + more)


class LastLayer(NamedTuple):
    """What the heads have learned in each environment's episode."""

    weight: Float[Array, "env member head feature obs"]
    """Posterior mean of the correction, in normalised units; it is added to the mean heads, and
    what belongs to the last feature, the 1, to their biases."""
    root: Float[Array, "env member group feature feature"]
    """Square root S of the posterior covariance in units of the noise variance, P = S Sᵀ."""
    squares: Float[Array, "env member head obs"]
    """Sum of the squared errors of what was foreseen, each over its spread."""
    count: Float[Array, "env member"]
    """Transitions that were learned from."""

    @classmethod
    def of_prior(cls, prior: Prior, num_envs: int, sizes: tuple[int, int, int]) -> "LastLayer":
        """Nothing learned yet.

        Args:
            prior: Where every episode starts.
            num_envs: How many environments.
            sizes: Heads, features (with the 1), and dimensions of an observation.
        """
        heads, features, obs_size = sizes
        start = prior.root(features)[:, None]
        return cls(
            jnp.zeros((num_envs, prior.members, heads, features, obs_size)),
            jnp.broadcast_to(start, (num_envs, prior.members, 1, features, features)),
            jnp.zeros((num_envs, prior.members, heads, obs_size)),
            jnp.zeros((num_envs, prior.members)),
        )

    def noise(self, prior: Prior) -> Float[Array, "env member head obs"]:
        """Variance of the noise in this episode: the prior's, corrected by the errors so far."""
        total = NOISE_DOF * prior.noise[:, None, :] + self.squares
        return total / (NOISE_DOF + self.count)[..., None, None]


class Forecast(NamedTuple):
    """What was expected of a transition before it was learned from."""

    innovation: Float[Array, "env member head obs"]
    """The residual minus what the correction foresaw."""
    projected: Float[Array, "env member group feature"]
    """Sᵀφ, whose squared norm is the variance that stems from the weights."""
    spread: Float[Array, "env member group"]
    """Predictive variance over the noise variance, n + φᵀPφ."""


def foresee(
    state: LastLayer, features: Float[Array, "env member feature"]
) -> Float[Array, "env member head obs"]:
    """What the corrections add to the heads' means, in normalised units."""
    return jnp.einsum("emi,emhio->emho", features, state.weight)


def forecast(state: LastLayer, seen: Observed) -> Forecast:
    """Predict a transition with what was learned so far."""
    projected = jnp.einsum("emgij,emi->emgj", state.root, seen.features)
    spread = seen.noise + jnp.square(projected).sum(-1)
    return Forecast(seen.residual - foresee(state, seen.features), projected, spread)


def update(state: LastLayer, seen: Observed, expected: Forecast) -> LastLayer:
    """Learn from one transition per environment (Potter's square-root filter).

    S loses a part of rank one, so the covariance can neither grow nor turn negative, however
    many transitions there are.
    """
    innovation, projected, spread = expected
    gain = jnp.einsum("emgij,emgj->emgi", state.root, projected) / spread[..., None]
    weight = state.weight + gain[..., :, None] * innovation[..., None, :]
    share = 1.0 / (1.0 + jnp.sqrt(seen.noise / spread))
    lost = share[..., None, None] * gain[..., :, None] * projected[..., None, :]
    learned = seen.learned_from
    squares = jnp.square(innovation) / spread[..., None] * learned[..., None, None]
    return LastLayer(weight, state.root - lost, state.squares + squares, state.count + learned)


def credence(
    expected: Forecast, state: LastLayer, prior: Prior
) -> Float[Array, "env member group"]:
    """How much a transition is believed, in (0, 1], if rare errors may be of any size.

    The weight of an observation under the t-distribution of `log_likelihood`, as in robust
    filters (Agamennoni, Nieto and Nebot, 2011); 1 up to one standard deviation. Heads that share
    their noise believe what the best of them does.

    Args:
        expected: What was foreseen, and how it differs.
        state: What was known before the transition.
        prior: Where the episode began.
    """
    dof = (NOISE_DOF + state.count)[..., None]
    var = jnp.maximum(expected.spread[..., None] * state.noise(prior), TINY)
    error = (jnp.square(expected.innovation) / var).mean(-1)
    if expected.spread.shape[-1] == 1:
        error = error.min(-1, keepdims=True)
    return jnp.clip((dof + 1.0) / (dof + error), TINY, 1.0)


def log_likelihood(
    expected: Forecast, state: LastLayer, prior: Prior
) -> Float[Array, "env member head"]:
    """Log-density of the transition under each head's forecast, summed over dimensions.

    How large the noise is in this episode is not known either: with an inverse-gamma prior, worth
    `NOISE_DOF` transitions, what is foreseen follows Student's t-distribution (Bishop, 2006,
    section 2.3.7). So heads that are wrong throughout an episode are not surprised by each error.

    Args:
        expected: What was foreseen, and how it differs.
        state: What was known before the transition.
        prior: Where the episode began.
    """
    dof = (NOISE_DOF + state.count)[..., None, None]
    var = jnp.maximum(expected.spread[..., None] * state.noise(prior), TINY)
    tail = jnp.log1p(jnp.square(expected.innovation) / (dof * var))
    gamma = jax.scipy.special.gammaln
    scale = gamma(0.5 * (dof + 1.0)) - gamma(0.5 * dof) - 0.5 * jnp.log(jnp.pi * dof * var)
    return (scale - 0.5 * (dof + 1.0) * tail).sum(-1)
