"""Box plots of the score over M, for Figures 1 and 5 (C2)."""

import json
from collections.abc import Sequence

import numpy as np

from experiments import rows
from experiments.plan import HEADS, Plan
from mapg_jax.config import Config
from mapg_jax.run_folder import RunFolder

FILE = "episodes.csv"


def runs(plan: Plan, envs: Sequence[str]) -> list[Config]:
    """Every M on those tasks."""
    return [config for env in envs for m in (1, *HEADS) for config in plan.over_seeds(env, heads=m)]


def measure(plan: Plan, folder: RunFolder) -> None:
    """Adds the return of every episode of the score."""
    key = rows.identity(folder.config)
    if not rows.holds(plan.results / FILE, key):
        returns = json.loads(folder.evaluation.read_text())["returns"]
        text = " ".join(f"{x:.6g}" for x in returns)
        rows.append(plan.results / FILE, [{**key, "returns": text}])


def section(plan: Plan, envs: Sequence[str], picture: str) -> str:
    """The picture, and what it shows."""
    found = rows.of(plan.results / FILE, runs(plan, envs))
    if not found:
        return rows.missing(runs(plan, envs))
    draw(found, envs).savefig(plan.results / picture, dpi=120)
    return (
        f"![Score over M]({picture})\n\n"
        "A box a value of M: quartiles and median of the returns of all episodes of all seeds, "
        "whiskers to 1.5 times the box, as the paper draws the episodes of one run; a point is the "
        "mean of one seed, and their scatter is what tells M apart from chance. M = 1 is DDPG."
    )


def draw(found: list[dict[str, str]], envs: Sequence[str]):
    """One panel a task."""
    from matplotlib.figure import Figure  # slow to import

    figure = Figure(figsize=(4 * len(envs), 4), layout="constrained")
    panels = figure.subplots(1, len(envs), squeeze=False)[0]
    for axes, env in zip(panels, envs, strict=True):
        heads = (1, *HEADS)
        for place, m in enumerate(heads):
            episodes = [
                np.array(row["returns"].split(), float)
                for row in found
                if row["env"] == env and row["heads"] == str(m)
            ]
            if episodes:
                axes.boxplot(
                    np.concatenate(episodes), positions=[place], widths=0.6, showfliers=False
                )
                means = [returns.mean() for returns in episodes]
                axes.plot([place] * len(means), means, "o", color="tab:blue", alpha=0.7)
        axes.set(title=env, xlabel="M", xlim=(-0.6, len(heads) - 0.4))
        axes.set_xticks(range(len(heads)), [str(m) for m in heads])
    panels[0].set(ylabel="return of an episode")
    return figure
