"""Bayesian last layer: heads that keep learning while they act, one transition at a time.

The part of the delta that a head's mean misses is a linear function of the features φ that the
head sees: the backbone's output, the context and a 1. For every environment, member, head and
dimension o,

    r_o = φᵀ w_o + ε,    w_o ~ N(0, σ_o² P₀),    ε ~ N(0, σ_o² n),

where r is the normalised delta minus the head's mean. P₀ and σ² are of the training data
(`last_layer_prior`); n is 1, or more for an outlier. The posterior covariance is σ_o² P, and P
depends on the features only, so heads and dimensions share it. A step of a Kalman filter takes in
each transition; P = S Sᵀ is kept as its square root. The posterior mean is added to the weights
of the head that plans, so imagined rollouts cost nothing more.

The physics may change in an episode. The evidence is the log Bayes factor of heads that have
learned nothing against those that have learned, summed up from transition to transition and never
below 0 (CUSUM; Page, 1954). A single outlier cannot exceed the threshold: it counts less instead,
by the weight that a Student-t likelihood gives it.

Sources: Bayesian linear regression (Bishop, 2006, section 3.3); ALPaCA (Harrison et al., 2018);
Potter's square-root filter (Maybeck, 1979, section 7.3); robust filters (Agamennoni, Nieto and
Nebot, 2011).
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from headway.data import where_env

GATE = 100.0
"""Deviations of the training data's deltas; larger residuals of a head count as this large, and
a transition that no head finds smaller teaches nothing."""
MAX_FEATURES = 1e8
"""Squared norm of the features; larger ones teach nothing."""
NOISE_DOF = 1.0
"""Transitions that the training data's noise variance is worth in an episode."""
CONFIRMATIONS = 3
"""Transitions, at least, that speak for changed physics before it is believed: one or two may be
contacts or faults of a sensor."""
TINY = 1e-12


class Prior(NamedTuple):
    """Distribution of the corrections at the beginning of an episode."""

    root: Float[Array, "member feature feature"]
    """Square root S₀ of the covariance in units of the noise variance, P₀ = S₀ S₀ᵀ."""
    noise: Float[Array, "member obs"]
    """Variance σ² of the noise, in normalised units."""


class Residuals(NamedTuple):
    """Transitions as the heads see them; `env` may be any batch."""

    features: Float[Array, "env member feature"]
    """The backbone's output, the context and a 1 (φ)."""
    residual: Float[Array, "env member head obs"]
    """The normalised delta minus each head's mean (r)."""
    logvar: Float[Array, "env member head obs"] | None = None
    """The heads' own log-variance; None if they are deterministic."""

    def gated(self, happened: Bool[Array, " env"]) -> "Residuals":
        """Features and residuals of zero where nothing happened or nothing can be true.

        A head that alone is absurdly wrong keeps its member's other heads from nothing.
        """
        size = jnp.square(self.features).sum(-1)
        plausible = (jnp.abs(self.residual) < GATE).all(-1).any(-1)
        kept = happened[:, None] & (size < MAX_FEATURES) & plausible
        residual = jnp.clip(jnp.nan_to_num(self.residual, nan=GATE), -GATE, GATE)
        return self._replace(
            features=jnp.where(kept[..., None], self.features, 0.0),
            residual=jnp.where(kept[..., None, None], residual, 0.0),
        )


class LastLayer(NamedTuple):
    """Posterior of the corrections in each environment's episode."""

    weight: Float[Array, "env member head feature obs"]
    """Mean of w, in normalised units; it is added to the mean heads, the last row to their
    biases."""
    root: Float[Array, "env member feature feature"]
    """S, with P = S Sᵀ."""
    squares: Float[Array, "env member head obs"]
    """Sum of the squared errors of the predictions, each over its variance in units of σ²."""
    count: Float[Array, "env member"]
    """Transitions that were learned from."""
    cusum: Float[Array, " env"]
    """Evidence that the physics has changed, as a log Bayes factor; never below 0."""

    @classmethod
    def init(cls, prior: Prior, num_envs: int, num_heads: int) -> "LastLayer":
        """The prior, at the beginning of an episode."""
        (members, size, _), obs_size = prior.root.shape, prior.noise.shape[-1]
        return cls(
            jnp.zeros((num_envs, members, num_heads, size, obs_size)),
            jnp.broadcast_to(prior.root, (num_envs, *prior.root.shape)),
            jnp.zeros((num_envs, members, num_heads, obs_size)),
            jnp.zeros((num_envs, members)),
            jnp.zeros(num_envs),
        )

    def correction(
        self, features: Float[Array, "env member feature"]
    ) -> Float[Array, "env member head obs"]:
        """Mean that is added to every head's mean, in normalised units."""
        return jnp.einsum("emi,emhio->emho", features, self.weight)


def observe(
    layer: LastLayer,
    prior: Prior,
    residuals: Residuals,
    happened: Bool[Array, " env"],
    change_threshold: float = 0.0,
) -> LastLayer:
    """Learn from one transition of every environment; start anew where the physics has changed.

    Args:
        layer: The posterior before.
        prior: Where the episode began.
        residuals: The transitions.
        happened: Where there was one.
        change_threshold: Log Bayes factor above which the physics has changed; 0 never looks.
    """
    seen = residuals.gated(happened)
    noise = jnp.ones_like(layer.count)
    if change_threshold:
        fresh = LastLayer.init(prior, len(happened), layer.weight.shape[2])
        # Nothing speaks for either where nothing can be learned: the last feature is 0 there.
        anew, learned = (
            seen.features[..., -1:] * log_likelihood(one, prior, seen) for one in (fresh, layer)
        )
        logsumexp = jax.scipy.special.logsumexp  # heads are equally likely
        log_bayes_factor = (logsumexp(anew, axis=-1) - logsumexp(learned, axis=-1)).mean(-1)
        most = change_threshold / (CONFIRMATIONS - 0.5)
        cusum = layer.cusum + jnp.minimum(log_bayes_factor, most)
        changed = cusum > change_threshold
        layer = layer._replace(cusum=jnp.maximum(cusum, 0.0))
        layer = where_env(changed, fresh, layer)
        outlier = (log_bayes_factor > most) & ~changed
        variance = 1.0 + innovate(layer, seen).variance
        more = variance / robust_weight(layer, prior, seen) - variance
        noise += jnp.where(outlier[:, None], more, 0.0)
    return update(layer, seen, noise)


class Innovation(NamedTuple):
    """New information of a transition, as in a Kalman filter."""

    error: Float[Array, "env member head obs"]
    """The residual minus the correction's mean, r - φᵀw."""
    projected: Float[Array, "env member feature"]
    """Sᵀφ."""
    variance: Float[Array, "env member"]
    """Parameter uncertainty φᵀPφ = |Sᵀφ|², in units of σ²."""


def innovate(layer: LastLayer, seen: Residuals) -> Innovation:
    """Compare a transition with its prediction by the posterior so far."""
    projected = jnp.einsum("emij,emi->emj", layer.root, seen.features)
    error = seen.residual - layer.correction(seen.features)
    return Innovation(error, projected, jnp.square(projected).sum(-1))


def update(layer: LastLayer, seen: Residuals, noise: Float[Array, "env member"]) -> LastLayer:
    """Condition on one transition per environment (Potter's square-root filter).

    S loses a part of rank one, so the covariance can neither grow nor turn negative, however
    many transitions there are.

    Args:
        layer: The posterior before.
        seen: The transitions, gated.
        noise: Relative variance n of their noise.
    """
    error, projected, variance = innovate(layer, seen)
    spread = noise + variance
    gain = jnp.einsum("emij,emj->emi", layer.root, projected) / spread[..., None]
    weight = layer.weight + gain[:, :, None, :, None] * error[..., None, :]
    share = 1.0 / (1.0 + jnp.sqrt(noise / spread))
    lost = share[..., None, None] * gain[..., :, None] * projected[..., None, :]
    learned = seen.features[..., -1]  # 1, or 0 where there is nothing to learn
    squares = jnp.square(error) * (learned / spread)[..., None, None]
    return LastLayer(
        weight, layer.root - lost, layer.squares + squares, layer.count + learned, layer.cusum
    )


def log_likelihood(
    layer: LastLayer, prior: Prior, seen: Residuals
) -> Float[Array, "env member head"]:
    """Log-density of a transition under each head's prediction, summed over dimensions.

    The noise of the episode is not known either: with an inverse-gamma prior, worth `NOISE_DOF`
    transitions, predictions follow Student's t-distribution (Bishop, 2006, section 2.3.7). So
    heads that are wrong throughout an episode are not surprised by each error.
    """
    error, dof, var = _student_t(layer, prior, seen)
    dof = dof[..., None, None]
    tail = jnp.log1p(jnp.square(error) / (dof * var))
    gamma = jax.scipy.special.gammaln
    scale = gamma(0.5 * (dof + 1.0)) - gamma(0.5 * dof) - 0.5 * jnp.log(jnp.pi * dof * var)
    return (scale - 0.5 * (dof + 1.0) * tail).sum(-1)


def robust_weight(layer: LastLayer, prior: Prior, seen: Residuals) -> Float[Array, "env member"]:
    """Weight in (0, 1] of a transition under the t-distribution of `log_likelihood`.

    1 up to one standard deviation. Heads share it, as the best of them has it.
    """
    error, dof, var = _student_t(layer, prior, seen)
    least = (jnp.square(error) / var).mean(-1).min(-1)
    return jnp.clip((dof + 1.0) / (dof + least), TINY, 1.0)


def _student_t(
    layer: LastLayer, prior: Prior, seen: Residuals
) -> tuple[Float[Array, "env member head obs"], Float[Array, "env member"], Array]:
    """Error, degrees of freedom and squared scale of a prediction, which is laid out as errors."""
    error, _, variance = innovate(layer, seen)
    dof = NOISE_DOF + layer.count
    noise = (NOISE_DOF * prior.noise[:, None] + layer.squares) / dof[..., None, None]
    return error, dof, jnp.maximum((1.0 + variance)[..., None, None] * noise, TINY)
