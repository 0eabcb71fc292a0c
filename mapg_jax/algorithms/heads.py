"""The paper's idea: M action proposals a state, one of them drawn, only its head updated.

`heads`, the number of heads in use, may be a traced value no larger than the static axis `M`; heads
past it are padding that is never drawn, averaged or updated, so that one program serves several M.
"""

from typing import Literal

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, Integer, PRNGKeyArray

Select = Literal["uniform", "argmax-q", "mean", "first"]
"""How one action is made of the M proposals."""
Behaviour = Literal["uniform", "argmax-q", "softmax-q"]
"""How the head that acts in training is chosen."""


def in_use(heads: Int[Array, ""], shape: tuple[int, ...]) -> Bool[Array, "... M"]:
    """Which heads are in use, for numbers of that shape, [*B, M]."""
    return _numbers(shape) < heads


def draw(key: PRNGKeyArray, heads: Int[Array, ""], shape: tuple[int, ...]) -> Int[Array, "..."]:
    """Heads drawn uniformly (MAPG, Algorithm 1); padding does not change the draw."""
    return jax.random.randint(key, shape, 0, heads)


def stored(head: Int[Array, "*B"], heads: int) -> Integer[Array, "*B"]:
    """Heads' numbers as the replay keeps them: in a byte where M, here static, fits one."""
    return head.astype(jnp.uint8 if heads <= 256 else jnp.int32)


def draw_by_value(
    key: PRNGKeyArray,
    values: Float[Array, "*B M"],
    temperature: Float[Array, "*B"],
    heads: Int[Array, ""],
) -> Int[Array, "*B"]:
    r"""Heads drawn with $p_m \propto \exp(Q_m / T)$; padding does not change the draw.

    Args:
      key: for one uniform number a state, which the sums of $p_m$ divide.
      values: $Q_m$.
      temperature: T, in units of Q.
      heads: M.
    """
    mask = in_use(heads, values.shape)
    centred = values - mean(values, heads)[..., None]
    # Equal values, as of one head, are all as probable.
    scaled = jnp.where(mask, centred / (temperature[..., None] + 1e-12), -jnp.inf)
    weight = jax.nn.softmax(scaled)
    below = jnp.cumsum(weight, -1) < jax.random.uniform(key, (*values.shape[:-1], 1))
    return jnp.minimum((below & mask).sum(-1), heads - 1)


def normal(key: PRNGKeyArray, shape: tuple[int, ...]) -> Float[Array, "*B M A"]:
    """Standard normal numbers for M actions a state; padding does not change those of a head."""
    *batch, heads, action_size = shape
    keys = jax.vmap(lambda m: jax.random.fold_in(key, m))(jnp.arange(heads))
    each = jax.vmap(lambda key: jax.random.normal(key, (*batch, action_size)))(keys)
    return jnp.moveaxis(each, 0, -2)


def best(values: Float[Array, "*B M"], heads: Int[Array, ""]) -> Int[Array, "*B"]:
    """The head in use that the critic values most."""
    return jnp.where(in_use(heads, values.shape), values, -jnp.inf).argmax(-1)


def take(proposals: Float[Array, "*B M A"], head: Integer[Array, "*B"]) -> Float[Array, "*B A"]:
    """The proposals of the given heads; the gradient reaches those heads alone."""
    chosen = head[..., None] == _numbers(proposals.shape[:-1])
    # A masked sum: the gradient of a gather would be a scatter, which XLA runs row by row on a CPU.
    return jnp.where(chosen[..., None], proposals, 0.0).sum(-2)


def mean(values: Float[Array, "*B M"], heads: Int[Array, ""]) -> Float[Array, "*B"]:
    r"""$\frac{1}{M} \sum_m v_m$ over the heads in use (MAPG, Eq. 6)."""
    mask = in_use(heads, values.shape)
    return jnp.where(mask, values, 0.0).sum(-1) / heads


def spread(proposals: Float[Array, "*B M A"], heads: Int[Array, ""]) -> Float[Array, "*B"]:
    r"""Standard deviation over the heads, averaged over the action's dimensions.

    $\frac{1}{A} \sum_a \sqrt{\frac{1}{M} \sum_m (\rho_{ma} - \bar\rho_a)^2}$, in units of [-1, 1].
    """
    per_dimension = jnp.swapaxes(proposals, -1, -2)
    centre = mean(per_dimension, heads)
    variance = mean(jnp.square(per_dimension - centre[..., None]), heads)
    return jnp.sqrt(variance).mean(-1)


def q_gap(values: Float[Array, "*B M"], heads: Int[Array, ""]) -> Float[Array, "*B"]:
    r"""$\max_m Q_m - \min_m Q_m$: 0 in an optimal policy (MAPG, section 3.2)."""
    mask = in_use(heads, values.shape)
    highest = jnp.where(mask, values, -jnp.inf).max(-1)
    return highest - jnp.where(mask, values, jnp.inf).min(-1)


def distance(proposals: Float[Array, "*B M A"], heads: Int[Array, ""]) -> Float[Array, "*B"]:
    r"""Mean distance between two heads, over the largest there can be.

    $\frac{1}{M (M-1)} \sum_{i \ne j} \|\rho_i - \rho_j\| / (2 \sqrt{A})$; 0 where M is 1.
    """
    difference = proposals[..., :, None, :] - proposals[..., None, :, :]
    each = jnp.linalg.norm(difference, axis=-1)
    mask = in_use(heads, proposals.shape[:-1])
    pairs = mask[..., :, None] & mask[..., None, :]
    total = jnp.where(pairs, each, 0.0).sum((-1, -2))
    return total / jnp.maximum(heads * (heads - 1), 1) / (2 * proposals.shape[-1] ** 0.5)


def choose(
    select: Select,
    key: PRNGKeyArray,
    proposals: Float[Array, "*B M A"],
    values: Float[Array, "*B M"],
    heads: Int[Array, ""],
) -> Float[Array, "*B A"]:
    """One action a state.

    Args:
      select: `uniform` draws a head, as the paper does in training and in evaluation; `argmax-q`
        takes the proposal the critic values most; `mean` averages the proposals; `first` takes
        head 0.
      key: used by `uniform` alone.
      proposals: of the actor.
      values: the critic's, used by `argmax-q` alone.
      heads: M.
    """
    batch = values.shape[:-1]
    if select == "uniform":
        return take(proposals, draw(key, heads, batch))
    if select == "argmax-q":
        return take(proposals, best(values, heads))
    if select == "mean":
        return mean(jnp.swapaxes(proposals, -1, -2), heads)
    return take(proposals, jnp.zeros(batch, jnp.int32))


def _numbers(shape: tuple[int, ...]) -> Int[Array, "... M"]:
    """The heads' numbers along the last axis."""
    return jnp.expand_dims(jnp.arange(shape[-1]), range(len(shape) - 1))
