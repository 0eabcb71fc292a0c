"""Episodes to returns: E episodes are E starts, one episode each."""

import functools
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import PRNGKeyArray

import envs
from mapg_jax.algorithms import heads, optima
from mapg_jax.training.agent import Agent, AgentState


class HeadStatistics(NamedTuple):
    """How the M proposals differ, averaged over states of the episodes (docs/metrics.md)."""

    spread: jax.Array  # [], in units of [-1, 1]
    q_gap: jax.Array  # [], in units of Q
    q_gap_relative: jax.Array  # [], over the standard deviation of Q
    head_distance: jax.Array  # [], between two heads, over the largest there can be
    optima_share: jax.Array  # [], of the optima of Q that have a head, over the starts


class Played(NamedTuple):
    """E finished episodes."""

    returns: jax.Array  # [E]
    lengths: jax.Array  # [E] steps
    heads: HeadStatistics
    metrics: dict[str, jax.Array]  # [E] each, the environment's at the last step


class _Sums(NamedTuple):
    """Over all states of the episodes so far."""

    states: jax.Array
    spread: jax.Array
    q_gap: jax.Array
    distance: jax.Array
    q: jax.Array
    q_square: jax.Array


class _Play(NamedTuple):
    """Episodes under way."""

    steps: jax.Array  # [] i32, taken by each that is alive
    env: envs.State  # leaves [E, ...]
    alive: jax.Array  # [E] bool
    returns: jax.Array  # [E]
    lengths: jax.Array  # [E] i32
    last: dict[str, jax.Array]  # [E] each, the metrics at the last step alive
    sums: _Sums


def play(
    env: envs.Env,
    agent: Agent,
    state: AgentState,
    key: PRNGKeyArray,
    *,
    episodes: int,
    time_limit: int,
    select: str,
) -> Played:
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

    def step(now: _Play) -> _Play:
        observation = jnp.asarray(now.env.obs)
        proposals, values = agent.proposals(state, observation)
        action = agent.act(state, observation, agent.key_of_step(state, act_key, now.steps), select)
        after = jax.vmap(env.step)(now.env, action)
        return _Play(
            steps=now.steps + 1,
            env=after,
            alive=now.alive & (after.done < 0.5),
            returns=now.returns + jnp.where(now.alive, after.reward, 0.0),
            lengths=now.lengths + now.alive,
            last=jax.tree.map(lambda x, y: jnp.where(now.alive, y, x), now.last, after.metrics),
            sums=_added(now.sums, now.alive, proposals, values, heads.mean(values, m) - pivot, m),
        )

    start = jax.vmap(env.reset)(jax.random.split(start_key, episodes))
    # Squares of deviations from a value near the mean keep their digits.
    proposals, values = agent.proposals(state, jnp.asarray(start.obs))
    pivot = heads.mean(values, m).mean()
    zeros, none = jnp.zeros(episodes), jnp.zeros(episodes, jnp.int32)
    sums = _Sums(*(jnp.zeros(()) for _ in _Sums._fields))
    first = _Play(none[0], start, jnp.ones(episodes, bool), zeros, none, start.metrics, sums)
    end = jax.lax.while_loop(lambda now: (now.steps < time_limit) & now.alive.any(), step, first)
    found = _optima_share(agent, state, jnp.asarray(start.obs), proposals)
    return Played(end.returns, end.lengths, _statistics(end.sums, found), end.last)


def _optima_share(agent: Agent, state: AgentState, observation, proposals) -> jax.Array:
    if not optima.can_be_searched(proposals.shape[-1]):
        return jnp.full((), jnp.nan)
    q_values = functools.partial(agent.q_values, state, observation)
    return jnp.nanmean(optima.share_found(q_values, proposals, state.hyper.heads))


def _added(sums: _Sums, alive, proposals, values, value, m) -> _Sums:
    """The sums with one state of each episode that is alive."""

    def total(x):  # what is stepped past its end may be of any value
        return jnp.where(alive, x, 0.0).sum()

    return _Sums(
        sums.states + alive.sum(),
        sums.spread + total(heads.spread(proposals, m)),
        sums.q_gap + total(heads.q_gap(values, m)),
        sums.distance + total(heads.distance(proposals, m)),
        sums.q + total(value),
        sums.q_square + total(jnp.square(value)),
    )


def _statistics(sums: _Sums, optima_share: jax.Array) -> HeadStatistics:
    mean = _Sums(*(x / sums.states for x in sums))
    q_std = jnp.sqrt(jnp.maximum(mean.q_square - jnp.square(mean.q), 0.0))
    gap_relative = jnp.where(q_std > 0, mean.q_gap / q_std, jnp.nan)
    return HeadStatistics(mean.spread, mean.q_gap, gap_relative, mean.distance, optima_share)


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
    from scipy.stats import t as student  # slow to import

    returns = np.asarray(returns, np.float64)
    n = len(returns)
    mean = float(returns.mean())
    std = float(returns.std(ddof=1)) if n > 1 else 0.0
    half = float(student.ppf(0.975, n - 1) * std / np.sqrt(n)) if n > 1 else 0.0
    return Summary(mean, std, (mean - half, mean + half), n)
