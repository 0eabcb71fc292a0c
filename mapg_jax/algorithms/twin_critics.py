"""Two critics of one shape, whose parameters have an axis of 2 in front (Fujimoto et al. 2018)."""

from typing import cast

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PRNGKeyArray

from mapg_jax.algorithms.base import Transition
from mapg_jax.algorithms.descent import Params
from mapg_jax.algorithms.networks import Critic


def init(
    critic: Critic,
    key: PRNGKeyArray,
    observation: Float[Array, "1 D"],
    actions: Float[Array, "1 1 A"],
) -> Params:
    """Parameters of both, leaves [2, ...]."""
    keys = jax.random.split(key)
    return jax.vmap(critic.init, in_axes=(0, None, None))(keys, observation, actions)


def values(
    critic: Critic,
    params: Params,
    observation: Float[Array, "*B D"],
    actions: Float[Array, "*B K A"],
) -> Float[Array, "2 *B K"]:
    """Q of K actions a state, by either critic."""
    apply = jax.vmap(critic.apply, in_axes=(0, None, None))
    return cast(Array, apply(params, observation, actions))


def loss(
    critic: Critic, params: Params, batch: Transition, target: Float[Array, "B"]
) -> tuple[Float[Array, ""], Float[Array, "B"]]:
    r"""$\sum_i \frac{1}{B} \sum_b (y_b - Q_i(s_b, a_b))^2$, and Q of the first critic."""
    q = values(critic, params, batch.observation, batch.action[:, None])[..., 0]
    return jnp.square(target[None] - q).mean(1).sum(), q[0]
