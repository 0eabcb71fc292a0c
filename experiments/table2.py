"""Table 2: DDPG, A3C and MAPG over M on five tasks, beside the paper's numbers (C1, C2, C9)."""

import pathlib
from collections.abc import Sequence

import numpy as np

from experiments import curves, rows, scores, selects
from experiments.plan import A3C, DDPG, Plan
from experiments.verdicts import waiting
from mapg_jax.reports import inference as statistics
from mapg_jax.reports.document import Table
from mapg_jax.reports.stratified import effect, van_elteren
from mapg_jax.runs.folder import RunFolder
from mapg_jax.training.config import Config

PAPER = pathlib.Path(__file__).with_name("paper_table2.csv")
"""Mean and 3σ over the 100 episodes of one run: the paper's Table 2, which has no M = 5."""
BOTH = (scores.means, curves.late)
"""The score, and the second score."""
Pair = tuple[np.ndarray, np.ndarray]
"""Scores of two arms on a task."""


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
    if not scores.of(plan, runs(plan)):
        return rows.missing(runs(plan))
    return "\n\n".join(
        (
            f"Mean ± 3σ over the {plan.base.final_episodes} episodes of a run, as the paper prints "
            "it; ours are averages of both over n seeds. The paper's tasks are the v1 of 2017, "
            "ours Gymnasium's v5. Humanoid has 348 dimensions here: the paper's 376 less 28 zeros.",
            beside_the_paper(plan).markdown(),
            "A3C acts by samples of its Gaussian, as in training; by its mean: "
            f"{mean_action(plan)}.",
            "The same with their uncertainty over seeds (95 %, by bootstrap), by the score, which "
            "decides, and by the second score, the mean of a run's last ten evaluations. P is the "
            "probability of improvement over DDPG; p is of the two-sided rank-sum test, and of a "
            "row alone, corrected for no other. Claims are judged above:",
            uncertainty(plan).markdown(),
            "Over the tasks that have all runs of both arms, by van Elteren's test and weights:",
            over_tasks(plan).markdown(),
        )
    )


def uncertainty(plan: Plan) -> Table:
    """An arm on a task a line, by both scores."""
    lines = []
    for env in plan.tasks:
        for label, changes in plan.arms().items():
            cell, plain = (plan.over_seeds(env, **arm) for arm in (changes, DDPG))
            if not (found := scores.of(plan, cell)):
                continue
            texts = []
            for score in BOTH:
                values = score(plan, cell)
                whole = len(values) == len(found)  # a second score is of all runs or of none
                texts.append(_rounded(statistics.mean(values)) if whole else "missing")
                values = values if whole else values[:0]
                texts += ["", ""] if label == "DDPG" else _against([(values, score(plan, plain))])
            lines.append([env, label, str(len(found)), *texts])
    return Table(("task", "arm", "n", "score", "P", "p", "second score", "P", "p"), lines)


def over_tasks(plan: Plan) -> Table:
    """An arm a line, by both scores, against DDPG on the tasks that have all runs of both."""
    lines = []
    for label, changes in plan.arms().items():
        arms = {env: [plan.over_seeds(env, **arm) for arm in (changes, DDPG)] for env in plan.tasks}
        arms = {env: both for env, both in arms.items() if not any(waiting(plan, a) for a in both)}
        if label != "DDPG" and arms:
            texts = []
            for score in BOTH:
                texts += _against([(score(plan, x), score(plan, y)) for x, y in arms.values()])
            lines.append([label, ", ".join(arms), *texts])
    return Table(("arm", "tasks", "P", "p", "P by the second score", "p"), lines)


def _against(pairs: Sequence[Pair]) -> list[str]:
    """P and p of the first against the second arms; nothing where an arm has no scores."""
    if not all(len(ours) and len(theirs) for ours, theirs in pairs):
        return ["", ""]
    return [f"{effect(pairs):.2f}", f"{van_elteren(pairs).either:.2g}"]


def _rounded(estimate: statistics.Estimate) -> str:
    """Whole numbers, but where they are small."""
    return f"{estimate:,.0f}" if abs(estimate.value) >= 100 else f"{estimate:.1f}"


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
