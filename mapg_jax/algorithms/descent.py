"""Gradient descent whose learning rate is a traced number, and a penalty of weights."""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import optax
from jaxtyping import Array, Float

from mapg_jax.algorithms import shards

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


class Descended(NamedTuple):
    """What a step down the gradient of a loss leaves."""

    params: Params
    optimizer: optax.OptState
    loss: Float[Array, ""]
    aux: Any
    gradient_norm: Float[Array, ""]


def minimize(
    loss: Callable[[Params], tuple[Float[Array, ""], Any]],
    optimizer: optax.GradientTransformation,
    params: Params,
    state: optax.OptState,
    learning_rate: Float[Array, ""],
) -> Descended:
    """One step of the optimiser down the gradient of a loss, averaged over shards.

    Args:
      loss: of the parameters, and what else is told of it.
      optimizer: scales gradients; the learning rate is applied after it.
      params: where the step starts.
      state: of the optimiser.
      learning_rate: of the step.
    """
    (value, aux), gradient = jax.value_and_grad(loss, has_aux=True)(params)
    gradient = shards.mean(gradient)
    params, state = descend(optimizer, params, gradient, state, learning_rate)
    return Descended(params, state, value, aux, optax.tree.norm(gradient))


def towards(target: Params, params: Params, tau: Float[Array, ""]) -> Params:
    r"""$\theta' \leftarrow \theta' + \tau (\theta - \theta')$."""
    return jax.tree.map(lambda x, y: x + tau * (y - x), target, params)
