"""Running mean and variance of observations."""

import jax
import jax.numpy as jnp
from flax import struct
from jaxtyping import Array, Float

from mapg_jax.algorithms import shards

VARIANCE_FLOOR = 1e-2  # of a dimension, as in the code the paper ran on


class NormalizerState(struct.PyTreeNode):
    """Count, mean and sum of squared deviations of all observations seen."""

    count: jax.Array  # [] f32
    mean: jax.Array  # [D]
    deviations: jax.Array  # [D], Σ (x - mean)²


def init(observation_size: int) -> NormalizerState:
    """No observations yet."""
    zeros = jnp.zeros(observation_size)
    return NormalizerState(jnp.zeros(()), zeros, zeros)


def update(state: NormalizerState, batch: Float[Array, "N D"]) -> NormalizerState:
    r"""The statistics with a batch added, of all shards (Chan, Golub and LeVeque 1983).

    $\delta = \bar x_B - \bar x,\; \bar x' = \bar x + \delta \frac{n_B}{n + n_B},\;
    S' = S + S_B + \delta^2 \frac{n\,n_B}{n + n_B}$
    """
    n = shards.total(batch.shape[0])
    count = state.count + n
    batch_mean = shards.mean(batch.mean(0))
    delta = batch_mean - state.mean
    return NormalizerState(
        count=count,
        mean=state.mean + delta * n / count,
        deviations=state.deviations
        + shards.total(jnp.square(batch - batch_mean[None]).sum(0))
        + jnp.square(delta) * state.count * n / count,
    )


def normalize(
    state: NormalizerState, observation: Float[Array, "*B D"], clip: float
) -> Float[Array, "*B D"]:
    r"""$\mathrm{clip}((s - \bar s) / \sigma, \pm c)$, σ² at least `VARIANCE_FLOOR`."""
    variance = state.deviations / jnp.maximum(state.count, 1.0)
    scale = jax.lax.rsqrt(jnp.maximum(variance, VARIANCE_FLOOR))
    front = range(observation.ndim - 1)
    centred = observation - jnp.expand_dims(state.mean, front)
    return jnp.clip(centred * jnp.expand_dims(scale, front), -clip, clip)
