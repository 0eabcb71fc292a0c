"""Gradient descent whose learning rate is a traced number."""

from typing import Any

import jax
import optax
from jaxtyping import Array, Float

Params = Any


def adam(max_gradient_norm: float | None) -> optax.GradientTransformation:
    """Adam without its learning rate; gradients are scaled down to the norm first, if any."""
    if max_gradient_norm is None:
        return optax.scale_by_adam()
    return optax.chain(optax.clip_by_global_norm(max_gradient_norm), optax.scale_by_adam())


def descend(
    optimizer: optax.GradientTransformation,
    params: Params,
    gradient: Params,
    state: optax.OptState,
    learning_rate: Float[Array, ""],
) -> tuple[Params, optax.OptState]:
    """Parameters and optimiser after one step."""
    step, state = optimizer.update(gradient, state, params)
    return jax.tree.map(lambda x, dx: x - learning_rate * dx, params, step), state
