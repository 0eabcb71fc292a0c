"""Figure 3: spread of the actions and angle within an episode of Pendulum, from hanging down."""

import functools
from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from envs.pendulum import Pendulum
from experiments import pictures, rows
from experiments.plan import FIRST_SEED, MAPG, Plan
from mapg_jax.algorithms import heads
from mapg_jax.reports.plots import COLOURS
from mapg_jax.runs.folder import RunFolder
from mapg_jax.runs.policy import Policy, open_policy
from mapg_jax.training.config import Config

STARTS = 100
START = 5.0  # degrees either side of hanging down, at rest
BIN = 10  # degrees
ANGLES = np.arange(0, 180, BIN) + BIN / 2
LINEAR = 1e-3
"""A spread up to which the axis of an episode is linear, and logarithmic from there."""
BINS, EPISODE = "fig3_bins.csv", "fig3_episode.csv"


def runs(plan: Plan) -> list[Config]:
    return [*judged(plan), *floor(plan)]


def judged(plan: Plan) -> list[Config]:
    """M = 10."""
    return plan.over_seeds("pendulum", **MAPG)


def floor(plan: Plan) -> list[Config]:
    """M = 10 where every update moves all heads alike: what spread is left without a reason."""
    return plan.over_seeds("pendulum", **MAPG, gradient="all")


def measure(plan: Plan, folder: RunFolder) -> None:
    """Mean spread by angle, over the states of all starts; and the first start's episode."""
    key = rows.identity(folder.config)
    if rows.holds(plan.measured / BINS, key):
        return
    angle, spread = play(open_policy(folder), folder.config)
    edges = np.arange(-180, 181, BIN)
    counts, _ = np.histogram(angle, edges)
    sums, _ = np.histogram(angle, edges, weights=spread)
    if key == rows.identity(runs(plan)[0]) and not rows.holds(plan.measured / EPISODE, key):
        episode = zip(angle[0], spread[0], strict=True)
        rows.append(
            plan.measured / EPISODE,
            [{**key, "step": t, "angle": f"{a:.2f}", "spread": f"{s:.5g}"}
             for t, (a, s) in enumerate(episode)],
        )  # fmt: skip
    rows.append(
        plan.measured / BINS,
        [
            {**key, "angle": (low + BIN / 2), "states": int(n), "spread": f"{total / n:.5g}"}
            for low, n, total in zip(edges[:-1], counts, sums, strict=True)
            if n
        ],
    )


def play(policy: Policy, config: Config) -> tuple[np.ndarray, np.ndarray]:
    """Angle (degrees, 0 hanging down, ±180 upright) and spread, [starts, steps] each."""
    env, agent, state = Pendulum(), policy.agent, policy.state
    start_key, head_key = jax.random.split(jax.random.key(config.seed))
    offset = jax.random.uniform(start_key, (STARTS,), minval=-START, maxval=START)

    def step(env_state, t):
        proposals, _ = agent.proposals(state, env_state.obs)
        head = heads.draw(jax.random.fold_in(head_key, t), state.hyper.heads, (STARTS,))
        cosine, sine, _ = env_state.obs.T
        angle = jnp.rad2deg(jnp.arctan2(-sine, -cosine))  # the paper's: Gymnasium's less 180°
        following = jax.vmap(env.step)(env_state, heads.take(proposals, head))
        return following, (angle, heads.spread(proposals, state.hyper.heads))

    @jax.jit
    def episodes(offset):
        first = jax.vmap(functools.partial(env.reset_to, theta_dot=0.0))(
            jnp.pi + jnp.deg2rad(offset)
        )
        return jax.lax.scan(step, first, jnp.arange(config.episode_steps()))[1]

    angle, spread = episodes(offset)
    return np.asarray(angle).T, np.asarray(spread).T


def section(plan: Plan) -> str:
    """The picture, and what it shows."""
    bins = _bins(plan, judged(plan))
    episode = rows.of(
        plan.measured / EPISODE, runs(plan)[:1], ("step", "angle", "spread"), each="step"
    )
    if not bins:
        return rows.missing(judged(plan))
    least = _bins(plan, floor(plan))
    pictures.save(plan, draw(bins, least, episode), "fig3")
    seeds = {row["seed"] for row in bins}
    return (
        "![Spread and angle within an episode](fig3.png)\n\n"
        f"{STARTS} episodes a seed, started at rest within {START:g}° of hanging down; n = "
        f"{len(seeds)} seeds. Left: mean spread of the ten actions by the angle from hanging, on "
        "either side, a thin line a seed; dashed, where every update moves all heads alike "
        "(gradient `all`): the floor of C4b. Right: "
        f"one episode of seed {FIRST_SEED}, as the paper shows it. 0° is hanging down, ±180° "
        "upright, the spread's axis linear below "
        f"{LINEAR:g}; actions are in [-1, 1]: a spread of 0.02 is 1 % of the range."
    )


def _bins(plan: Plan, runs: Sequence[Config]) -> list[dict[str, Any]]:
    """Mean spread by angle, and of how many states."""
    return rows.of(plan.measured / BINS, runs, ("angle", "states", "spread"), each="angle")


def by_angle(bins: Sequence[rows.Row], seed: str) -> list[float]:
    """The mean spread of one seed at ANGLES either side of hanging, nan where no state was."""
    found = []
    for angle in ANGLES:
        at = [row for row in bins if row["seed"] == seed and abs(row["angle"]) == angle]
        states = [row["states"] for row in at]
        spread = [row["spread"] for row in at]
        found.append(np.average(spread, weights=states) if at else np.nan)
    return found


def draw(bins: Sequence[rows.Row], least: Sequence[rows.Row], episode: Sequence[rows.Row]):
    """Spread by angle, all seeds, beside the floor; angle and spread over one episode."""
    from matplotlib.figure import Figure  # slow to import

    figure = Figure(figsize=(10, 4), layout="constrained")
    left, right = figure.subplots(1, 2)
    arms = (("M = 10", bins, COLOURS[1], "-"), ("gradient all", least, COLOURS[2], "--"))
    for label, of_arm, colour, style in arms:
        if not of_arm:
            continue
        lines = np.array([by_angle(of_arm, seed) for seed in sorted({x["seed"] for x in of_arm})])
        left.plot(ANGLES, lines.T, linewidth=0.5, alpha=0.5, color=colour, linestyle=style)
        seen = np.isfinite(lines).any(0)
        median = np.nanmedian(lines[:, seen], 0)
        label = f"{label}, median of n = {len(lines)}"
        left.plot(ANGLES[seen], median, linewidth=2, color=colour, linestyle=style, label=label)
    left.set(xlabel="degrees from hanging down", ylabel="spread of the actions")
    left.set(xticks=range(0, 181, 30), title="By angle, over all states", yscale="log")
    left.legend(frameon=False)

    time = [row["step"] for row in episode]
    right.plot(time, [row["spread"] for row in episode], color=COLOURS[1])
    right.set(xlabel="step", title=f"One episode, M = 10, seed {FIRST_SEED}")
    right.set_ylabel("spread of the actions", color=COLOURS[1])
    right.set_yscale("symlog", linthresh=LINEAR)  # one spike would squash the rest
    right.set_ylim(bottom=0)
    angles = right.twinx()
    angles.plot(time, [row["angle"] for row in episode], ".", ms=3, color="0.4")
    angles.set(ylim=(-185, 185), yticks=range(-180, 181, 60))
    angles.set_ylabel("angle, degrees", color="0.4")
    return figure


def spread_by_seed(plan: Plan, runs: Sequence[Config]) -> dict[str, list[float]]:
    """Of every seed: mean spread at most 30° from hanging, between 30° and 150°, and beyond.

    nan where no state of a seed is in that range.
    """
    means: dict[str, list[float]] = {"hanging": [], "between": [], "upright": []}
    bins = _bins(plan, runs)
    for seed in sorted({row["seed"] for row in bins}, key=int):
        of_seed = [row for row in bins if row["seed"] == seed]
        angle, states, spread = (
            np.array([row[k] for row in of_seed]) for k in ("angle", "states", "spread")
        )
        angle = np.abs(angle)
        where = {"hanging": angle < 30, "between": (angle > 30) & (angle < 150),
                 "upright": angle > 150}  # fmt: skip
        for name, mask in where.items():
            mean = np.average(spread[mask], weights=states[mask]) if mask.any() else np.nan
            means[name].append(float(mean))
    return means
