"""The density of a uniform mixture of M diagonal Gaussians; heads past M are padding."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from mapg_jax.algorithms.heads import in_use


def log_gaussian(
    x: Float[Array, "..."], mean: Float[Array, "..."], log_std: Float[Array, "..."], axis: int = -1
) -> Float[Array, "..."]:
    r"""$-\sum_i (\frac{(x_i - \mu_i)^2}{2 \sigma_i^2} + \log \sigma_i + \frac{1}{2} \log 2\pi)$.

    The sum is over one axis; the others broadcast.
    """
    scaled = (x - mean) * jnp.exp(-log_std)
    return -(0.5 * jnp.square(scaled) + log_std + 0.5 * jnp.log(2 * jnp.pi)).sum(axis)


def log_density(
    x: Float[Array, "*B K A"],
    mean: Float[Array, "*B M A"],
    log_std: Float[Array, "*B M A"],
    heads: Int[Array, ""],
) -> Float[Array, "*B K"]:
    r"""$\log \frac{1}{M} \sum_m N(x; \mu_m, \sigma_m^2)$ of K points a state."""
    # What is summed over comes first, [A, M, K, *B]: a CPU sums a short last axis slowly.
    x, mean, log_std = (jnp.moveaxis(y, (-1, -2), (0, 1)) for y in (x, mean, log_std))
    each = log_gaussian(x[:, None], mean[:, :, None], log_std[:, :, None], axis=0)
    known = jnp.expand_dims(in_use(heads, each.shape[:1]), range(1, each.ndim))
    # Padding is taken out before the exponential, where its gradient would be 0 times infinity.
    each = jnp.where(known, each, -jnp.inf)
    return jnp.moveaxis(jax.nn.logsumexp(each, axis=0) - jnp.log(heads), 0, -1)
