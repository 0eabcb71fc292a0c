"""The density of a uniform mixture of M diagonal Gaussians; heads past M are padding."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from mapg_jax.algorithms.heads import in_use


def log_gaussian(
    x: Float[Array, "*B A"], mean: Float[Array, "*B A"], log_std: Float[Array, "*B A"]
) -> Float[Array, "*B"]:
    r"""$-\sum_i (\frac{(x_i - \mu_i)^2}{2 \sigma_i^2} + \log \sigma_i + \frac{1}{2} \log 2\pi)$."""
    scaled = (x - mean) * jnp.exp(-log_std)
    return -(0.5 * jnp.square(scaled) + log_std + 0.5 * jnp.log(2 * jnp.pi)).sum(-1)


def log_density(
    x: Float[Array, "*B K A"],
    mean: Float[Array, "*B M A"],
    log_std: Float[Array, "*B M A"],
    heads: Int[Array, ""],
) -> Float[Array, "*B K"]:
    r"""$\log \frac{1}{M} \sum_m N(x; \mu_m, \sigma_m^2)$ of K points a state."""
    x, mean, log_std = x[..., :, None, :], mean[..., None, :, :], log_std[..., None, :, :]
    each = log_gaussian(*jnp.broadcast_arrays(x, mean, log_std))
    # Padding is taken out before the exponential, where its gradient would be 0 times infinity.
    each = jnp.where(in_use(heads, each.shape), each, -jnp.inf)
    return jax.nn.logsumexp(each, axis=-1) - jnp.log(heads)
