"""Figure 2: spread of the ten actions and return while Pendulum is learnt."""

from typing import NamedTuple

import numpy as np
import scipy.stats

from experiments import curves, rows
from experiments.plan import MAPG, Plan
from mapg_jax.reports import inference as statistics
from mapg_jax.training.config import Config

STEPS = 100_000
"""The return rises within the first tenth of them: an evaluation every 50,000 would miss it."""
EVALUATIONS = 400


def runs(plan: Plan) -> list[Config]:
    """Short runs of their own, looked at more often and over more starts than the others."""
    steps = min(STEPS, plan.base.steps // 2)
    looks = {
        "evaluate_every": max(1, steps // EVALUATIONS),
        "evaluation_episodes": plan.base.final_episodes,
        "evaluation_starts": "fixed",
    }
    return plan.over_seeds("pendulum", **MAPG, steps=steps, **looks)


def section(plan: Plan) -> str:
    """The picture, and what it shows."""
    found = curves.of(plan, runs(plan))
    if not found:
        return rows.missing(runs(plan))
    draw(found).savefig(plan.results / "fig2.png", dpi=120)
    config = runs(plan)[0]
    every = np.median(np.diff(found[0]["env_steps"], prepend=0))
    return (
        "![Spread and return during training](fig2.png)\n\n"
        f"Pendulum, M = 10, n = {len(found)} seeds, a line a seed; runs of {config.steps:,} steps, "
        f"with an evaluation of {config.evaluation_episodes} episodes without noise every "
        f"{every:,.0f}. The spread is in units of the range [-1, 1] of actions.\n\n"
        "Rank correlation of spread with return, mean over seeds with Student's 95 % interval: "
        f"{_while_learning(found)} over the first tenth of the steps, in which the return rises. "
        "Over all steps, as the protocol has it, it is in the ledger (C3): nine tenths of those "
        "evaluations come after the rise, and rank little but the starts that were drawn. The "
        "first number was added when the second had been seen, and enters no verdict."
    )


def _while_learning(found: list[dict[str, np.ndarray]]) -> str:
    first = [curve["env_steps"] <= curve["env_steps"][-1] / 10 for curve in found]
    pairs = [(c["spread"][f], c["return_mean"][f]) for c, f in zip(found, first, strict=True)]
    return f"{statistics.student([_correlation(*pair) for pair in pairs]):.2f}"


def _correlation(x: np.ndarray, y: np.ndarray) -> float:
    """Spearman's; nan where there is nothing to rank, or a number never changes."""
    ranked = len(x) > 1 and np.ptp(x) > 0 and np.ptp(y) > 0
    return float(scipy.stats.spearmanr(x, y).statistic) if ranked else np.nan


def draw(found: list[dict[str, np.ndarray]]):
    """Return above, spread below, over environment steps."""
    from matplotlib.figure import Figure  # slow to import

    figure = Figure(figsize=(7, 5), layout="constrained")
    upper, lower = figure.subplots(2, sharex=True)
    for curve in found:
        label = f"seed {curve['seed'][0]:.0f}"
        upper.plot(curve["env_steps"], curve["return_mean"], linewidth=1, label=label)
        lower.plot(curve["env_steps"], curve["spread"], linewidth=1)
    upper.set(ylabel="return", title="Pendulum, M = 10")
    figure.legend(loc="outside right upper", frameon=False)
    lower.set(xlabel="environment steps", ylabel="spread of the actions", xscale="log")
    lower.set_ylim(bottom=0)
    return figure


class BySeed(NamedTuple):
    """What C3 is judged by, a number a seed.

    nan where a number that never changes has no rank, or the median spread is 0.
    """

    with_step: list[float]
    """Rank correlation of spread with step."""
    with_return: list[float]
    """Rank correlation of spread with return."""
    spikes: list[float]
    """The largest spread of the second half of training over that half's median."""


def statistics_by_seed(plan: Plan) -> BySeed:
    """Of every seed that has finished."""
    found = BySeed([], [], [])
    for curve in curves.of(plan, runs(plan)):
        spread = curve["spread"]
        found.with_step.append(_correlation(spread, curve["env_steps"]))
        found.with_return.append(_correlation(spread, curve["return_mean"]))
        later = spread[curve["env_steps"] > curve["env_steps"][-1] / 2]
        median = np.median(later)
        found.spikes.append(float(later.max() / median) if median > 0 else np.nan)
    return found
