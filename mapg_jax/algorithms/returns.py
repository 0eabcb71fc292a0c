"""What a step is worth: targets of one step, of n steps, and generalised advantages."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float


def td_target(
    reward: Float[Array, "B"], discount: Float[Array, "B"], next_value: Float[Array, "B"]
) -> Float[Array, "B"]:
    r"""One-step return.

    $y_b = r_b + \gamma_b\, V'(s'_b)$ with $V' = \frac{1}{M} \sum_m Q'(s', \rho'_m(s'))$ (MAPG,
    Eq. 6; DDPG where M = 1).

    Args:
      reward: $r$, reward units per step.
      discount: $\gamma_b$, 0 where the episode terminated (truncation keeps it).
      next_value: $V'$ of the target networks.
    """
    return reward + discount * next_value


def n_step_returns(
    reward: Float[Array, "T N"],
    discount: Float[Array, "T N"],
    ended: Bool[Array, "T N"],
    next_value: Float[Array, "T N"],
) -> Float[Array, "T N"]:
    r"""The longest return that each step of the rollout has.

    $R_t = r_t + \gamma_t R_{t+1}$, where $V(s_{t+1})$ stands for $R_{t+1}$ if the episode ended at
    t or t is the last step (Mnih et al. 2016, Algorithm S3).

    Args:
      reward: $r_t$, reward units per step.
      discount: $\gamma_t$, 0 where the episode terminated (truncation keeps it).
      ended: whether the episode ended at t, either way.
      next_value: $V(s_{t+1})$ of what the step observed, before any reset.
    """

    def back(following, row):
        reward, discount, ended, next_value = row
        following = reward + discount * jnp.where(ended, next_value, following)
        return following, following

    rows = reward, discount, ended, next_value
    return jax.lax.scan(back, next_value[-1], rows, reverse=True)[1]


def generalized_advantages(
    reward: Float[Array, "T N"],
    discount: Float[Array, "T N"],
    ended: Bool[Array, "T N"],
    value: Float[Array, "T N"],
    next_value: Float[Array, "T N"],
    trace: Float[Array, ""],
) -> Float[Array, "T N"]:
    r"""$A_t = \sum_{k \ge 0} (\prod_{i<k} \gamma_{t+i} \lambda) \delta_{t+k}$.

    $\delta_t = r_t + \gamma_t V(s_{t+1}) - V(s_t)$ (Schulman et al. 2016, Eq. 16); the sum goes up
    to the episode's end.

    Args:
      reward: $r_t$, reward units per step.
      discount: $\gamma_t$, 0 where the episode terminated (truncation keeps it).
      ended: whether the episode ended at t, either way.
      value: $V(s_t)$.
      next_value: $V(s_{t+1})$ of what the step observed, before any reset.
      trace: λ.
    """
    difference = reward + discount * next_value - value

    def back(following, row):
        difference, discount, ended = row
        following = difference + jnp.where(ended, 0.0, discount * trace * following)
        return following, following

    rows = difference, discount, ended
    return jax.lax.scan(back, jnp.zeros_like(reward[0]), rows, reverse=True)[1]
