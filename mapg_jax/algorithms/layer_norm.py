"""Layer norm and ReLU (Ba, Kiros and Hinton 2016) whose sums are matrix products.

Sums are products with ones here, in gradients too, and on matrices of two axes: XLA on a CPU runs
those fast on every machine tried, and sums over an axis, of more axes above all, slowly on some.
"""

import jax
import jax.numpy as jnp
from flax import linen as nn
from jaxtyping import Array, Float

EPSILON = 1e-6  # added to the variance


def _matmul(x, y):
    return jnp.matmul(x, y, precision=jax.lax.Precision.HIGHEST)  # accelerators would take TF32


def _mean(x):
    """Over the last axis, which stays with size 1."""
    width = x.shape[-1]
    return _matmul(x, jnp.full((width, 1), 1 / width, x.dtype))


def _along(x, width):
    """`x`, [..., 1], along a last axis of this width."""
    return _matmul(x, jnp.ones((1, width), x.dtype))


def _over(x, batch):
    """`x`, [W], over a batch, [B, W]."""
    return _matmul(jnp.ones((batch, 1), x.dtype), x.reshape(1, -1))


def _standardized(x):
    centred = x - _mean(x)
    inverse = jax.lax.rsqrt(_mean(jnp.square(centred)) + EPSILON)
    return centred * inverse, inverse


@jax.custom_jvp
def _layer_norm_relu(x, scale, bias):
    return jax.nn.relu(_standardized(x)[0] * scale[None] + bias[None])


@_layer_norm_relu.defjvp
def _layer_norm_relu_jvp(primals, tangents):
    x, scale, bias = primals
    dx, dscale, dbias = tangents
    batch, width = x.shape
    standard, inverse = _standardized(x)
    y = jax.nn.relu(standard * scale[None] + bias[None])
    # Transposed, each mean is a sum by a product, then a broadcast, which costs nothing.
    mean, slope = (_along(z.sum(-1, keepdims=True) / width, width) for z in (dx, standard * dx))
    dstandard = inverse * (dx - mean - standard * slope)
    dy = dstandard * scale[None] + standard * _over(dscale, batch) + _over(dbias, batch)
    return y, jnp.where(y > 0, dy, 0.0)


def layer_norm_relu(
    x: Float[Array, "*B W"], scale: Float[Array, "W"], bias: Float[Array, "W"]
) -> Float[Array, "*B W"]:
    r"""$\max(0, g \odot (x - \mu) / \sqrt{\sigma^2 + 10^{-6}} + b)$.

    $\mu$ and $\sigma^2$ are the mean and the variance of x over the last axis.
    """
    flat = _layer_norm_relu(x.reshape(-1, x.shape[-1]), scale, bias)
    return flat.reshape(x.shape)


class LayerNorm(nn.Module):
    """`layer_norm_relu` with its parameters, which are named as flax's."""

    @nn.compact
    def __call__(self, x: Float[Array, "*B W"]) -> Float[Array, "*B W"]:
        width = x.shape[-1:]
        scale = self.param("scale", nn.initializers.ones, width)
        bias = self.param("bias", nn.initializers.zeros, width)
        return layer_norm_relu(x, scale, bias)
