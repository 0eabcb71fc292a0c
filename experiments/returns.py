"""What each head returns from the same states, by Monte Carlo, beside actions at random (C8)."""

import functools
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

import envs
from experiments import rows
from experiments.plan import MAPG, Plan
from mapg_jax.algorithms import heads
from mapg_jax.reports import inference as statistics
from mapg_jax.reports.document import Table
from mapg_jax.runs.folder import RunFolder
from mapg_jax.runs.policy import Policy, open_policy
from mapg_jax.training.config import Config

FILE = "returns.csv"
STATES, REPEATS, ACTIONS = 20, 4, 10
HORIZON = 300
"""Steps; γ³⁰⁰ is 0.05."""


class Returns(NamedTuple):
    """Discounted returns, and Q, from the same states."""

    heads: np.ndarray  # [S, M, R], that head first, uniform draws after it
    held: np.ndarray  # [S, M, 1], that head to the end: nothing is left to draw
    actions: np.ndarray  # [S, K, R], an action at random first, uniform draws after it
    q_heads: np.ndarray  # [S, M]
    q_actions: np.ndarray  # [S, K]


def runs(plan: Plan) -> list[Config]:
    """M = 10 on every task of Table 2."""
    return [config for env in plan.tasks for config in plan.over_seeds(env, **MAPG)]


def measure(plan: Plan, folder: RunFolder) -> None:
    """Adds the scatter between heads, and between actions at random, of a run's last policy."""
    key = rows.identity(folder.config)
    if rows.holds(plan.measured / FILE, key):
        return
    found = play(open_policy(folder), folder.config)
    gap, span = (np.ptp(q, axis=1).mean() for q in (found.q_heads, found.q_actions))
    numbers = {
        "between_heads": scatter(found.heads),
        "held": scatter(found.held),
        "between_actions": scatter(found.actions),
        "q_gap": gap / span if span > 0 else np.nan,
    }
    row = {**key, **{name: f"{value:.5g}" for name, value in numbers.items()}}
    rows.append(plan.measured / FILE, [row])


def scatter(returns: np.ndarray) -> float:
    """Standard deviation between expected returns at a state, [S, K, R]; chance is taken off.

    The variance of the means of R repeats less a share 1 / R of that of the repeats, over states;
    of one repeat nothing is taken off.
    """
    between, repeats = returns.mean(-1).var(-1, ddof=1), returns.shape[-1]
    within = returns.var(-1, ddof=1).mean(-1) / repeats if repeats > 1 else 0.0
    return float(np.sqrt(max(0.0, (between - within).mean())))


def play(policy: Policy, config: Config, horizon: int = HORIZON) -> Returns:
    """Returns from STATES states of the policy's own episodes."""
    env, agent, state = policy.env, policy.agent, policy.state
    m, size = int(state.hyper.heads), env.action_size
    visit_key, action_key, play_key = jax.random.split(jax.random.key(config.seed), 3)
    half = max(1, config.episode_steps() // 2)
    starts = jax.jit(functools.partial(_visited, policy, half))(visit_key)
    observation = jnp.asarray(starts.obs)
    proposals, q_heads = agent.proposals(state, observation)
    proposals, q_heads = proposals[:, :m], q_heads[:, :m]
    random = jax.random.uniform(action_key, (STATES, ACTIONS, size), minval=-1.0, maxval=1.0)
    q_actions = agent.q_values(state, observation, random)
    # By state: every head and every action R times, and every head once that is held.
    first = jnp.concatenate(
        [jnp.repeat(proposals, REPEATS, 1), jnp.repeat(random, REPEATS, 1), proposals], 1
    )
    draws = (m + ACTIONS) * REPEATS
    held = jnp.tile(jnp.concatenate([jnp.full(draws, -1), jnp.arange(m)]), STATES)
    many = jax.tree.map(lambda x: jnp.repeat(x, draws + m, 0), starts)
    steps = min(horizon, config.episode_steps())
    follow = jax.jit(functools.partial(_followed, policy, config.discount, steps))
    found = np.asarray(follow(many, first.reshape(-1, size), held, play_key))
    drawn, whole = np.split(found.reshape(STATES, -1), [draws], 1)
    drawn = drawn.reshape(STATES, -1, REPEATS)
    q = np.asarray(q_heads), np.asarray(q_actions)
    return Returns(drawn[:, :m], whole[..., None], drawn[:, m:], *q)


def _visited(policy: Policy, steps: int, key: jax.Array) -> envs.State:
    """One state of each of STATES episodes, uniformly among their first steps."""
    env, agent, state = policy.env, policy.agent, policy.state
    start_key, act_key, keep_key = jax.random.split(key, 3)
    first = jax.vmap(env.reset)(jax.random.split(start_key, STATES))

    def step(carry, t):
        now, kept, alive = carry
        keep = alive & (jax.random.uniform(jax.random.fold_in(keep_key, t), (STATES,)) * t < 1)
        kept = _where(keep, now, kept)
        key = jax.random.fold_in(act_key, t)
        after = jax.vmap(env.step)(now, agent.act(state, jnp.asarray(now.obs), key, "uniform"))
        return (after, kept, alive & (after.done < 0.5)), None

    carry = first, first, jnp.ones(STATES, bool)
    return jax.lax.scan(step, carry, jnp.arange(1, steps + 1))[0][1]


def _followed(policy: Policy, discount: float, steps: int, starts, first, held, key) -> jax.Array:
    """Discounted returns after a first action: of the held head, or of draws where it is -1."""
    env, agent, state = policy.env, policy.agent, policy.state

    def step(carry, t):
        now, total, alive = carry
        proposals, _ = agent.proposals(state, jnp.asarray(now.obs))
        drawn = heads.draw(jax.random.fold_in(key, t), state.hyper.heads, held.shape)
        action = heads.take(proposals, jnp.where(held < 0, drawn, held))
        after = jax.vmap(env.step)(now, jnp.where(t == 0, first, action))
        total += jnp.where(alive, discount**t * after.reward, 0.0)
        return (after, total, alive & (after.done < 0.5)), None

    carry = starts, jnp.zeros(len(held)), jnp.ones(len(held), bool)
    return jax.lax.scan(step, carry, jnp.arange(steps))[0][1]


def _where(mask: jax.Array, new: envs.State, old: envs.State) -> envs.State:
    """Instances of one batch or the other."""

    def choose(x, y):
        return jnp.where(mask.reshape(-1, *[1] * (x.ndim - 1)), x, y)

    return jax.tree.map(choose, new, old)


def ratios(plan: Plan, env: str, column: str = "between_heads") -> list[float]:
    """Scatter between heads over that between actions at random, a number a seed."""
    numbers = (column, "between_actions")
    found = rows.of(plan.measured / FILE, plan.over_seeds(env, **MAPG), numbers)
    pairs = [tuple(row[name] for name in numbers) for row in found]
    return [ours / theirs if theirs > 0 else np.nan for ours, theirs in pairs]


def section(plan: Plan) -> str:
    """A line a task."""
    lines = []
    for env in plan.tasks:
        found = rows.of(plan.measured / FILE, plan.over_seeds(env, **MAPG), ("q_gap",))
        gaps = [row["q_gap"] for row in found]
        cells = [
            statistics.student(x) for x in (ratios(plan, env), ratios(plan, env, "held"), gaps)
        ]
        lines.append([env, str(len(found)), *(f"{estimate:.2g}" for estimate in cells)])
    if not any(int(line[1]) for line in lines):
        return rows.missing(runs(plan))
    header = ("task", "n", "that head first", "held to the end", "critic: Q-gap over range of Q")
    return Table(header, lines).markdown() + (
        "\n\nStandard deviation between the expected returns of the ten heads from the same state, "
        f"over that between {ACTIONS} actions drawn at random there; {STATES} states a run, "
        f"{REPEATS} episodes each (experiments/protocol.md, C8). Mean over n seeds with Student's "
        "95 % interval. 0 would be heads that are worth the same, 1 heads that differ as much as "
        "actions at random. The last two columns enter no verdict."
    )
