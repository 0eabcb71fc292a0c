"""Whether the score grows with M (C2a)."""

from collections.abc import Mapping

import numpy as np

from experiments import curves, scores, table2
from experiments.comparisons import Score
from experiments.plan import Plan
from experiments.verdicts import UNDECIDED, Verdict, by_seeds, waiting
from mapg_jax.reports import inference as statistics
from mapg_jax.training.config import Config

ENVS = ("hopper", "walker2d")
"""Where it is claimed to."""
SIMULATIONS, RESAMPLES = 400, 1_000
"""Of the power, whose interval is a bootstrap of its own in every simulation."""
Groups = Mapping[int, np.ndarray]
"""The scores of each M."""


def runs(plan: Plan) -> list[Config]:
    """Every M, on both tasks."""
    return [config for cell in _cells(plan) for config in cell]


def c2a(plan: Plan) -> Verdict:
    """The rank correlation of score with M, on two tasks."""
    wide, narrow, shown = [], [], []
    found = {env: of for env in ENVS if (of := _by_heads(plan, env, scores.means))}
    for env, groups in found.items():
        estimate = statistics.spearman(groups)
        narrow.append(estimate.low > 0)
        wide.append(statistics.spearman(groups, 1 - 0.05 / len(ENVS)).high < 0)
        shown.append(f"{env} {estimate:.2f}")
    least = min([len(scores.of(plan, cell)) for cell in _cells(plan)], default=0)
    verdict = waiting(plan, runs(plan)) or by_seeds(
        least, len(narrow) == len(ENVS) and all(narrow), any(wide)
    )
    effect = f"rank correlation: {'; '.join(shown)}" if shown else ""
    chance = f"{power(found):.0%}" if verdict == UNDECIDED else ""
    text = "the score grows with M on Hopper and Walker2d"
    return Verdict("C2a", text, verdict, effect, chance, _evidence(plan, found))


def _evidence(plan: Plan, found: Mapping[str, Groups]) -> str:
    """The second score's correlations, and how many seeds there are."""
    late = {env: _by_heads(plan, env, curves.late) for env in found}
    second = [
        f"{env} {statistics.spearman(groups):.2f}"
        for env, groups in late.items()
        if _sizes(groups) == _sizes(found[env])
    ]
    counts = [f"{env} {_counts(found.get(env, {}))}" for env in ENVS]
    texts = [f"by the second score {'; '.join(second)}"] if second else []
    return "; ".join([*texts, f"n: {'; '.join(counts)}"]) if found else ""


def power(found: Mapping[str, Groups]) -> float:
    """How often the rule would say supported if the paper's means were true.

    As many scores as there are, drawn from those of each M with replacement and moved to the mean
    that stands to DDPG's as in the paper. An M that the paper has not lies between its neighbours,
    by the logarithm.
    """
    rng = np.random.default_rng(0)
    grown = np.ones(SIMULATIONS, bool)
    for env, groups in found.items():
        moved = _moved(env, groups)
        for k in range(SIMULATIONS):
            if grown[k]:
                drawn = {m: rng.choice(of_m, len(of_m)) for m, of_m in moved.items()}
                grown[k] = statistics.spearman(drawn, resamples=RESAMPLES).low > 0
    return float(grown.mean())


def _moved(env: str, groups: Groups) -> Groups:
    """The scores around the means that the paper says."""
    ratios = {1: 1.0, **{m: table2.ratio(env, f"M = {m}") for m in groups if m > 1}}
    known = {m: ratio for m, ratio in ratios.items() if ratio is not None}
    means = groups[1].mean() * np.interp(
        np.log(list(groups)), np.log(list(known)), list(known.values())
    )
    return {
        m: of_m - of_m.mean() + mean for (m, of_m), mean in zip(groups.items(), means, strict=True)
    }


def _cells(plan: Plan) -> list[list[Config]]:
    envs = [env for env in ENVS if env in plan.tasks]
    return [plan.over_seeds(env, heads=m) for env in envs for m in (1, *plan.heads)]


def _sizes(groups: Groups) -> dict[int, int]:
    return {m: len(values) for m, values in groups.items()}


def _counts(groups: Groups) -> str:
    """How many seeds each M has."""
    return ", ".join(f"{len(values)} of M = {m}" for m, values in groups.items()) or "none"


def _by_heads(plan: Plan, env: str, score: Score) -> Groups:
    """The scores of each M on one task; nothing while there are fewer than two of them."""
    groups = {m: score(plan, plan.over_seeds(env, heads=m)) for m in (1, *plan.heads)}
    groups = {m: of_m for m, of_m in groups.items() if len(of_m)}
    return groups if len(groups) > 1 else {}
