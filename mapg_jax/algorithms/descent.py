"""Gradient descent whose learning rate is a traced number, and a penalty of weights."""

from typing import Any

import jax
import jax.numpy as jnp
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


def kernel_l2(params: Params) -> Float[Array, ""]:
    r"""$\frac{1}{2} \sum_W \|W\|^2$ over the weight matrices; biases and layer norms are free."""
    leaves = jax.tree_util.tree_leaves_with_path(params)
    kernels = [x for path, x in leaves if "kernel" in jax.tree_util.keystr(path)]
    return 0.5 * jax.tree.reduce(jnp.add, [jnp.square(x).sum() for x in kernels])
