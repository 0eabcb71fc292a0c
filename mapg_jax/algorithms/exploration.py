"""Noise added to the executed action, in units of [-1, 1]."""

from typing import Literal

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, PRNGKeyArray

from mapg_jax.algorithms import shards

Noise = Literal["ou", "gaussian", "none"]

OU_THETA = 0.15  # 1/s, pull towards 0
OU_DT = 1e-2  # s, time per environment step


def advance(
    kind: Noise,
    key: PRNGKeyArray,
    noise: Float[Array, "N A"],
    scale: Float[Array, "#N 1"],
) -> Float[Array, "N A"]:
    r"""The next noise of every environment.

    `ou`: $x' = x - \theta x\,dt + \sigma \sqrt{dt}\,\varepsilon$ (Ornstein-Uhlenbeck by
    Euler-Maruyama, as in the code the paper ran on); `gaussian`:
    $x' = \sigma \varepsilon$; `none`: 0.

    Args:
      kind: of noise.
      key: for $\varepsilon$, standard normal.
      noise: $x$.
      scale: $\sigma$, one for all environments or one each.
    """
    if kind == "none":
        return jnp.zeros_like(noise)
    normal = jax.random.normal(key, noise.shape)
    if kind == "gaussian":
        return scale * normal
    return noise - OU_THETA * OU_DT * noise + scale * jnp.sqrt(OU_DT) * normal


def scales(
    first: Float[Array, ""], last: Float[Array, ""], environments: int
) -> Float[Array, "N 1"]:
    r"""σ of every environment: $\sigma_i = \sigma_1 + (\sigma_N - \sigma_1) \frac{i-1}{N-1}$.

    N are those of all shards of the run, of which this one has `environments`.
    """
    place = np.arange(environments, dtype=np.float32) + shards.number() * environments
    ramp = place / max(1, shards.count() * environments - 1)
    return first + (last - first) * ramp[:, None]


def random_start(
    key: PRNGKeyArray, updates: Int[Array, ""], action: Float[Array, "N A"]
) -> Float[Array, "N A"]:
    """Uniformly random actions before the first update, and `action` from then on."""
    anything = jax.random.uniform(
        jax.random.fold_in(key, 2), action.shape, minval=-1.0, maxval=1.0
    )  # of no stream that `split` makes of the key
    return jnp.where(updates == 0, anything, action)
