"""Episodes to returns: E episodes are E starts, one episode each."""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import scipy.stats
from jaxtyping import PRNGKeyArray

import envs
from mapg_jax.algorithms import heads
from mapg_jax.training.agent import Agent, AgentState


class HeadStatistics(NamedTuple):
    """How the M proposals differ, averaged over all states of the episodes (docs/metrics.md)."""

    spread: jax.Array  # [], in units of [-1, 1]
    q_gap: jax.Array  # [], in units of Q
    q_gap_relative: jax.Array  # [], over the standard deviation of Q


class Episodes(NamedTuple):
    """E finished episodes."""

    returns: jax.Array  # [E]
    lengths: jax.Array  # [E] steps
    heads: HeadStatistics
    metrics: dict[str, jax.Array]  # [E] each, the environment's at the last step


class _Sums(NamedTuple):
    states: jax.Array
    spread: jax.Array
    q_gap: jax.Array
    q: jax.Array
    q_square: jax.Array


def play(
    env: envs.Env,
    agent: Agent,
    state: AgentState,
    key: PRNGKeyArray,
    *,
    episodes: int,
    time_limit: int,
    select: str,
) -> Episodes:
    """Plays E episodes side by side, without noise, until the last has ended.

    Args:
      env: the bare environment.
      agent: the agent.
      state: its state.
      key: for the starts and the choice of actions.
      episodes: E.
      time_limit: steps after which an episode is cut off.
      select: how one action is made of the proposals.
    """
    start_key, act_key = jax.random.split(key)
    m = state.hyper.heads

    def step(carry):
        t, env_state, alive, returns, lengths, last, sums = carry
        proposals, values = agent.proposals(state, env_state.obs)
        action = agent.act(state, env_state.obs, jax.random.fold_in(act_key, t), select)
        value = heads.mean(values, m) - pivot

        def total(x):  # what is stepped past its end may be of any value
            return jnp.where(alive, x, 0.0).sum()

        sums = _Sums(
            sums.states + alive.sum(),
            sums.spread + total(heads.spread(proposals, m)),
            sums.q_gap + total(heads.q_gap(values, m)),
            sums.q + total(value),
            sums.q_square + total(jnp.square(value)),
        )
        env_state = jax.vmap(env.step)(env_state, action)
        returns = returns + jnp.where(alive, env_state.reward, 0.0)
        last = jax.tree.map(lambda old, new: jnp.where(alive, new, old), last, env_state.metrics)
        alive_next = alive & (env_state.done < 0.5)
        return t + 1, env_state, alive_next, returns, lengths + alive, last, sums

    env_state = jax.vmap(env.reset)(jax.random.split(start_key, episodes))
    # Squares of deviations from a value near the mean keep their digits.
    pivot = heads.mean(agent.proposals(state, jnp.asarray(env_state.obs))[1], m).mean()
    zeros = jnp.zeros(episodes)
    first = (
        jnp.zeros((), jnp.int32),
        env_state,
        jnp.ones(episodes, bool),
        zeros,
        jnp.zeros(episodes, jnp.int32),
        env_state.metrics,
        _Sums(*(jnp.zeros(()) for _ in _Sums._fields)),
    )
    *_, returns, lengths, last, sums = jax.lax.while_loop(
        lambda carry: (carry[0] < time_limit) & carry[2].any(), step, first
    )
    mean = _Sums(*(x / sums.states for x in sums))
    q_std = jnp.sqrt(jnp.maximum(mean.q_square - jnp.square(mean.q), 0.0))
    gap_relative = jnp.where(q_std > 0, mean.q_gap / q_std, jnp.nan)
    return Episodes(returns, lengths, HeadStatistics(mean.spread, mean.q_gap, gap_relative), last)


class Summary(NamedTuple):
    """Returns of E episodes in four numbers."""

    mean: float
    std: float
    """With E - 1 in the denominator; 0 of one episode."""
    ci95: tuple[float, float]
    """Student's interval of the mean over episodes of this one policy; not over seeds."""
    episodes: int


def summarize(returns: Any) -> Summary:
    """Mean, standard deviation and 95 % interval of episode returns."""
    returns = np.asarray(returns, np.float64)
    n = len(returns)
    mean = float(returns.mean())
    std = float(returns.std(ddof=1)) if n > 1 else 0.0
    half = float(scipy.stats.t.ppf(0.975, n - 1) * std / np.sqrt(n)) if n > 1 else 0.0
    return Summary(mean, std, (mean - half, mean + half), n)
