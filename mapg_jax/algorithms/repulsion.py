"""Directions that keep the proposals of a state apart, and a floor that credits them in turn.

Each is added to the slope that a head climbs anyway, so that nothing changes where its weight is 0.
All leave padding alone.
"""

from typing import Literal

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

Repulsion = Literal["none", "stein", "inverse"]
"""How the proposals of a state repel each other."""

SOFTENING = 0.05  # of the inverse distance, in units of [-1, 1]: equal proposals do not divide by 0


def stein(
    actions: Float[Array, "*B M A"],
    slopes: Float[Array, "*B M A"],
    weight: Float[Array, ""],
    heads: Int[Array, ""],
) -> Float[Array, "*B M A"]:
    r"""What Stein's direction adds to a head's own slope.

    $M \phi_m - g_m = \sum_{j \ne m} k(a_j, a_m) g_j + \alpha \sum_j \nabla_{a_j} k(a_j, a_m)$ with
    $k(x, y) = \exp(-\|x - y\|^2 / h)$: Stein variational gradient descent (Liu and Wang 2016,
    Eq. 8) to the density $\propto \exp(Q / \alpha)$, times $\alpha M$, so that a head far from all
    others climbs as it would alone. $h \log (M + 1)$ is the mean of $\|a_i - a_j\|^2$ over pairs
    (theirs takes the median, which would have to be sorted out).

    Args:
      actions: $a_m$.
      slopes: $g_m = \nabla_a Q(s, a_m)$.
      weight: $\alpha$, in units of Q; 0 turns all of it off.
      heads: M; what lies past it is padding.
    """
    difference = actions[..., :, None, :] - actions[..., None, :, :]  # [m, j]: a_m - a_j
    square = jnp.square(difference).sum(-1)
    pairs = _pairs(heads, square.shape)
    count = jnp.maximum(heads * (heads - 1), 1)
    width = jnp.where(pairs, square, 0.0).sum((-1, -2)) / count / jnp.log1p(heads)
    width = jnp.maximum(width, 1e-8)[..., None, None]
    kernel = jnp.where(pairs, jnp.exp(-square / width), 0.0)
    pull = kernel @ slopes
    push = ((2 * kernel / width)[..., None] * difference).sum(-2)
    return jnp.where(weight > 0, pull + weight * push, 0.0)


def inverse_distance(
    actions: Float[Array, "*B M A"], weight: Float[Array, ""], heads: Int[Array, ""]
) -> Float[Array, "*B M A"]:
    r"""$-\alpha \nabla_{a_m} \frac{1}{M-1} \sum_{j \ne m} (\|a_m - a_j\|^2 + \epsilon^2)^{-1/2}$.

    The repulsion of Q3C (2510.18828), softened by $\epsilon$.

    Args:
      actions: $a_m$.
      weight: $\alpha$, in units of Q times the action's.
      heads: M; what lies past it is padding.
    """
    difference = actions[..., :, None, :] - actions[..., None, :, :]
    square = jnp.square(difference).sum(-1)
    slope = jnp.where(_pairs(heads, square.shape), (square + SOFTENING**2) ** -1.5, 0.0)
    push = (slope[..., None] * difference).sum(-2) / jnp.maximum(heads - 1, 1)
    return weight * push


def credit(values: Float[Array, "*B M"], temperature: Float[Array, ""]) -> Float[Array, "*B M"]:
    r"""What head m is credited with: how far it comes above those before it.

    $T \log(1 + \exp((Q_m - F_m) / T))$ with $F_m = \max_{j<m} Q_j$, so that its slope is
    $\sigma((Q_m - F_m) / T) \nabla Q_m$; head 0 has Q itself. It is SAVO's surrogate
    $\max(Q, F_m)$ (2410.11833), smoothed here by T instead of by a network.

    Args:
      values: $Q_m$; no gradient goes through the floor.
      temperature: T, in units of Q.
    """
    highest = jax.lax.cummax(jax.lax.stop_gradient(values), axis=values.ndim - 1)
    floor = highest[..., :-1]
    above = temperature * jax.nn.softplus((values[..., 1:] - floor) / temperature)
    return jnp.concatenate([values[..., :1], above], -1)


def _pairs(heads: Int[Array, ""], shape: tuple[int, ...]) -> Bool[Array, "... M M"]:
    """Which (m, j) are two different heads in use."""
    number = jnp.arange(shape[-1])
    row, column = number[:, None], number[None]
    pairs = (row != column) & (row < heads) & (column < heads)
    return jnp.expand_dims(pairs, range(len(shape) - 2))
