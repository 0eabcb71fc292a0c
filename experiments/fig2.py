"""Figure 2: spread of the ten actions and return during training, Pendulum."""

import numpy as np
import scipy.stats

from experiments import curves, rows
from experiments.plan import MAPG, Plan
from mapg_jax.config import Config


def runs(plan: Plan) -> list[Config]:
    return plan.over_seeds("pendulum", **MAPG)


def section(plan: Plan) -> str:
    """The picture, and what it shows."""
    found = curves.of(plan, runs(plan))
    if not found:
        return rows.missing(runs(plan))
    draw(found).savefig(plan.results / "fig2.png", dpi=120)
    return (
        "![Spread and return during training](fig2.png)\n\n"
        f"Pendulum, M = 10, n = {len(found)} seeds, a line a seed; every point is an evaluation of "
        f"{plan.base.evaluation_episodes} episodes without noise. The spread is in units of the "
        "range [-1, 1] of actions."
    )


def draw(found: list[dict[str, np.ndarray]]):
    """Return above, spread below, over environment steps."""
    from matplotlib.figure import Figure  # slow to import

    figure = Figure(figsize=(7, 5), layout="constrained")
    upper, lower = figure.subplots(2, sharex=True)
    for curve in found:
        label = f"seed {curve['seed'][0]:.0f}"
        upper.plot(curve["env_steps"], curve["return_mean"], marker=".", label=label)
        lower.plot(curve["env_steps"], curve["spread"], marker=".")
    upper.set(ylabel="return", title="Pendulum, M = 10")
    upper.legend()
    lower.set(xlabel="environment steps", ylabel="spread of the actions")
    lower.set_ylim(bottom=0)
    return figure


def statistics_by_seed(plan: Plan) -> dict[str, list[float]]:
    """Of every seed: two rank correlations, and the spikes of the second half of training.

    nan where a number that never changes has no rank, or the median spread is 0.
    """
    found: dict[str, list[float]] = {"spread with step": [], "spread with return": [], "spikes": []}
    for curve in curves.of(plan, runs(plan)):
        spread = curve["spread"]
        for name, other in (("step", curve["env_steps"]), ("return", curve["return_mean"])):
            ranked = np.ptp(spread) > 0 and np.ptp(other) > 0
            correlation = scipy.stats.spearmanr(spread, other).statistic if ranked else np.nan
            found[f"spread with {name}"].append(float(correlation))
        later = spread[curve["env_steps"] > curve["env_steps"][-1] / 2]
        median = np.median(later)
        found["spikes"].append(float(later.max() / median) if median > 0 else np.nan)
    return found
