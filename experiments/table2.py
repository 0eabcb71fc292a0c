"""Table 2: DDPG, A3C and MAPG over M on five tasks, beside the paper's numbers (C1, C2, C9)."""

import pathlib

import numpy as np

from experiments import rows, scores, selects
from experiments.plan import A3C, Plan
from mapg_jax.reports.document import Table
from mapg_jax.reports.report import arms_table
from mapg_jax.runs.folder import RunFolder
from mapg_jax.training.config import Config

PAPER = pathlib.Path(__file__).with_name("paper_table2.csv")
"""Mean and 3σ over the 100 episodes of one run: the paper's Table 2, which has no M = 5."""


def runs(plan: Plan) -> list[Config]:
    return [
        config
        for env in plan.tasks
        for changes in plan.arms().values()
        for config in plan.over_seeds(env, **changes)
    ]


def measure(plan: Plan, folder: RunFolder) -> None:
    """Scores A3C by its mean action too: the protocol's score samples, as it acts in training."""
    if folder.config.algorithm == "a3c":
        selects.measure(plan, folder, ["mean"])


def section(plan: Plan) -> str:
    """Ours beside the paper's; then the same scores with their uncertainty over seeds."""
    found = scores.of(plan, runs(plan))
    if not found:
        return rows.missing(runs(plan))
    return "\n\n".join(
        (
            f"Mean ± 3σ over the {plan.base.final_episodes} episodes of a run, as the paper prints "
            "it; ours are averages of both over n seeds. The paper's tasks are the v1 of 2017, "
            "ours Gymnasium's v5. Humanoid has 348 dimensions here: the paper's 376 less 28 zeros.",
            beside_the_paper(plan).markdown(),
            "A3C acts by samples of its Gaussian, as in training; by its mean: "
            f"{mean_action(plan)}.",
            "The same scores with their uncertainty over seeds (docs/report.md). The p of a row is "
            "its own, corrected for no other; claims are judged above:",
            arms_table(found),
        )
    )


def mean_action(plan: Plan) -> str:
    """A3C's scores without sampling, task by task."""
    texts = []
    for env in plan.tasks:
        values = selects.means(plan, plan.over_seeds(env, **A3C), "mean")
        texts.append(f"{env} {scores.summary(values)}")
    return "; ".join(texts)


def beside_the_paper(plan: Plan) -> Table:
    """Three lines a task: ours, those of version 1, which none of ours are among, the paper's."""
    lines, earlier = [], plan._replace(version=1)
    for env in plan.tasks:
        ours = [_ours(plan, env, changes) for changes in plan.arms().values()]
        older = [_ours(earlier, env, changes) for changes in plan.arms().values()]
        papers = [_paper(env, label) for label in plan.arms()]
        lines.append([env, "here", *ours])
        if set(older) != {"missing"}:
            lines.append(["", "version 1", *older])
        lines.append(["", "the paper", *papers])
    return Table(("task", "", *plan.arms()), lines)


def _ours(plan: Plan, env: str, changes) -> str:
    found = scores.of(plan, plan.over_seeds(env, **changes))
    if not found:
        return "missing"
    mean, std = np.mean([(r.return_mean, r.return_std) for r in found], 0)
    return f"{mean:.0f} ± {3 * std:.0f} (n = {len(found)})"


def ratio(env: str, label: str) -> float | None:
    """The paper's mean of an arm over that of DDPG; None where it has no such number."""
    means = {row["arm"]: float(row["mean"]) for row in rows.read(PAPER) if row["env"] == env}
    return means[label] / means["DDPG"] if label in means else None


def _paper(env: str, label: str) -> str:
    for row in rows.read(PAPER):
        if (row["env"], row["arm"]) == (env, label):
            return f"{row['mean']} ± {row['three_sigma']}"
    return ""
