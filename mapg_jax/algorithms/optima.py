"""The optima of a critic over all actions of a state, by a grid search."""

from collections.abc import Callable

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Float32, Int

from mapg_jax.algorithms import heads as head_rules

ACROSS = 41
"""Points of an action's range."""
NEAR = 0.1
"""An optimum has a head if one is as near in every dimension: two steps of the grid."""
HIGH = 0.1
"""A peak is an optimum if it lies no further below the highest, in ranges of Q over the actions."""


def can_be_searched(action_size: int) -> bool:
    """Whether a grid over the actions is small enough."""
    return action_size <= 2


def share_found(
    q_values: Callable[[Float[Array, "*B K A"]], Float[Array, "*B K"]],
    proposals: Float[Array, "*B M A"],
    heads: Int[Array, ""],
) -> Float[Array, "*B"]:
    r"""The share of the optima of $Q(s, \cdot)$ that have a head.

    $\lvert \{o \in O: \min_m \|\rho_m - o\|_\infty \le \epsilon\} \rvert / \lvert O \rvert$, O: the
    points of the grid above all of their neighbours and among the upper tenth of Q's range over it;
    nan where there is none, as of a critic that does not look at the action.

    Args:
      q_values: the critic's, of any K actions of each state.
      proposals: of those states, A at most 2.
      heads: M.
    """
    *batch, _, action_size = proposals.shape
    actions = _grid(action_size)
    values = q_values(jnp.broadcast_to(actions, (*batch, *actions.shape)))
    optimum = _optima(values.reshape(*batch, *(ACROSS,) * action_size), action_size)
    optimum = optimum.reshape(*batch, -1)
    points = jnp.expand_dims(actions[:, None], range(len(batch)))
    off = jnp.abs(proposals[..., None, :, :] - points).max(-1)  # [*B, K, M]
    near = (off <= NEAR) & head_rules.in_use(heads, off.shape)
    return (optimum & near.any(-1)).sum(-1) / optimum.sum(-1)


def _grid(action_size: int) -> Float32[np.ndarray, "K A"]:
    axis = np.linspace(-1, 1, ACROSS, dtype=np.float32)
    return np.stack(np.meshgrid(*[axis] * action_size, indexing="ij"), -1).reshape(-1, action_size)


def _optima(values: Float[Array, "..."], action_size: int) -> Bool[Array, "..."]:
    axes = tuple(range(values.ndim - action_size, values.ndim))
    highest = values.max(axes, keepdims=True)
    lowest = values.min(axes, keepdims=True)
    optimum = values >= highest - HIGH * (highest - lowest)
    edges = [(1, 1) if axis in axes else (0, 0) for axis in range(values.ndim)]
    padded = jnp.pad(values, edges, constant_values=-jnp.inf)
    for offset in np.ndindex(*(3,) * action_size):
        if set(offset) != {1}:
            place = (slice(start, start + ACROSS) for start in offset)
            optimum &= values > padded[(..., *place)]
    return optimum
