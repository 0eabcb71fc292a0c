"""Figure 2: spread of the ten actions and return while Pendulum is learnt."""

from typing import Any, NamedTuple

import numpy as np
import scipy.stats

from experiments import curves, pictures, rows
from experiments.plan import MAPG, Plan
from mapg_jax.reports.plots import COLOURS
from mapg_jax.training.config import Config

STEPS = 100_000
"""The return rises within the first tenth of them: an evaluation every 50,000 would miss it."""
EVALUATIONS = 400
LEARNING = 0.1
"""Of the steps: in them the return rises."""


def runs(plan: Plan) -> list[Config]:
    """Short runs of their own, looked at more often and over more starts than the others."""
    steps = min(STEPS, plan.base.steps // 2)
    looks = {
        "evaluate_every": max(1, steps // EVALUATIONS),
        "evaluation_episodes": plan.base.final_episodes,
        "evaluation_starts": "fixed",
    }
    return plan.over_seeds("pendulum", **MAPG, steps=steps, **looks)


class BySeed(NamedTuple):
    """What C3 is judged by, a number a seed.

    nan where a number never changes, and has no rank, or the spread is 0, and has no logarithm.
    """

    with_step: list[float]
    """Rank correlation of spread with step in the learning phase."""
    with_return: list[float]
    """Rank correlation of spread with return there, both less their trend."""
    spikes: list[float]
    """log of the highest spike of the second half over those of shuffled increments."""
    raw_return: list[float]
    """As `with_return`, their trends left in; it decides nothing."""
    over_levels: list[float]
    """As `spikes`, over those of shuffled levels; it decides nothing."""


def by_seed(plan: Plan) -> BySeed:
    """Of every seed that has finished."""
    found = BySeed([], [], [], [], [])
    for curve in curves.of(plan, runs(plan)):
        steps, spread = curve["env_steps"], curve["spread"]
        learning = steps <= LEARNING * steps[-1]
        phase = steps[learning], spread[learning], curve["return_mean"][learning]
        found.with_step.append(correlation(phase[1], phase[0]))
        found.with_return.append(detrended(phase[1], phase[2], phase[0]))
        found.spikes.append(spike_excess(spread[steps > steps[-1] / 2]))
        found.raw_return.append(correlation(phase[1], phase[2]))
        found.over_levels.append(spike_excess(spread[steps > steps[-1] / 2], of_levels=True))
    return found


def correlation(x: np.ndarray, y: np.ndarray) -> float:
    """Spearman's; nan where there is nothing to rank, or a number never changes."""
    ranked = len(x) > 1 and np.ptp(x) > 0 and np.ptp(y) > 0
    spearman: Any = scipy.stats.spearmanr  # whose result is of a type made at run time
    return float(spearman(x, y).statistic) if ranked else np.nan


def detrended(x: np.ndarray, y: np.ndarray, time: np.ndarray) -> float:
    """Correlation of the ranks of x and y, each less its least-squares line on the rank of time.

    A drift that x and y share is no relation between them.
    """
    if len(x) < 4:
        return np.nan
    ranks = [scipy.stats.rankdata(values) for values in (x, y, time)]
    line = np.stack([np.ones(len(time)), ranks[2]], 1)
    left = [of - line @ np.linalg.lstsq(line, of, rcond=None)[0] for of in ranks[:2]]
    size = [np.linalg.norm(of) for of in left]
    return float(left[0] @ left[1] / (size[0] * size[1])) if min(size) > 1e-9 * len(x) else np.nan


def spike_excess(spread: np.ndarray, shuffles: int = 1_000, of_levels: bool = False) -> float:
    """How much higher the highest spike of log spread is than by chance.

    The height of a spike is the lesser of the rise before one evaluation and the fall after it;
    chance is the median of the highest ones of series with the same increments in random order, so
    that noise about a level counts as spikes too; or with the same levels in random order.
    """
    if len(spread) < 3 or not (spread > 0).all():
        return np.nan
    levels = np.log(spread)
    increments = np.diff(levels)
    shuffled = np.tile(levels if of_levels else increments, (shuffles, 1))
    shuffled = np.random.default_rng(0).permuted(shuffled, axis=1)
    chance = _highest(np.diff(shuffled) if of_levels else shuffled)
    return float(_highest(increments) - np.median(chance))


def _highest(increments: np.ndarray) -> np.ndarray:
    """The highest spike of series of increments, [..., T] → [...]."""
    return np.minimum(increments[..., :-1], -increments[..., 1:]).max(-1)


def section(plan: Plan) -> str:
    """The picture, and what it shows."""
    found = curves.of(plan, runs(plan))
    if not found:
        return rows.missing(runs(plan))
    pictures.save(plan, draw(found), "fig2")
    config = runs(plan)[0]
    every = np.median(np.diff(found[0]["env_steps"], prepend=0))
    return (
        "![Spread and return during training](fig2.png)\n\n"
        f"Pendulum, M = 10, n = {len(found)} seeds: thin lines, and their median, thick; runs of "
        f"{config.steps:,} steps, with an evaluation of {config.evaluation_episodes} episodes from "
        f"the same starts every {every:,.0f}. Actions are in [-1, 1]: a "
        "spread of 0.02 is 1 % of the range. Grey: the learning phase, in which C3 is judged on "
        "the fall of the spread and on the return; its spikes are sought in the second half."
    )


def draw(found: list[dict[str, np.ndarray]]):
    """Return above, spread below, over environment steps."""
    from matplotlib.figure import Figure  # slow to import

    figure = Figure(figsize=(7, 5), layout="constrained")
    panels = figure.subplots(2, sharex=True)
    steps = found[0]["env_steps"]
    for axes, column, colour in zip(panels, ("return_mean", "spread"), COLOURS[1:], strict=False):
        lines = np.array([curve[column] for curve in found])
        axes.plot(steps, lines.T, linewidth=0.5, alpha=0.5, color=colour)
        label = f"median of n = {len(found)}"
        axes.plot(steps, np.median(lines, 0), linewidth=2, color=colour, label=label)
        axes.axvspan(steps[0], LEARNING * steps[-1], color="0.92", zorder=0)
        axes.legend(frameon=False)
    panels[0].set(ylabel="return of an evaluation", title="Pendulum, M = 10")
    panels[1].set(xlabel="environment steps", ylabel="spread of the actions")
    panels[1].set(xscale="log", yscale="log")
    return figure
