"""Other algorithms with several actions, against themselves with one (C10)."""

import itertools
from collections.abc import Mapping
from typing import Any

from experiments import comparisons, pictures, rows, scores
from experiments.comparisons import ALPHA, Comparison
from experiments.plan import DDPG, MAPG, Plan
from experiments.verdicts import (
    CONTRADICTED,
    SUPPORTED,
    UNDECIDED,
    Verdict,
    undecidable,
    waiting,
)
from mapg_jax.reports.document import Table
from mapg_jax.reports.inference import holm
from mapg_jax.reports.plots import draw_forest
from mapg_jax.reports.stratified import Test, effect, power, van_elteren
from mapg_jax.training.config import Config

NAMED = ("naf", "trpo")
"""By the paper; C10 is about them."""
ALGORITHMS = (*NAMED, "ppo", "td3", "sac")
OF_NAF = ("pendulum", "hopper")
MARGINAL: Mapping[str, Any] = {"gradient": "marginal"}
"""The exact mixture's ratio, which is shown beside the head's own and judges nothing."""


def runs(plan: Plan) -> list[Config]:
    """All that C10 is judged on, and then what is shown beside it; seed by seed of each."""
    arms = [*judged(plan).values(), *beside(plan).values()]
    by_seed = [sorted(arm.runs(plan), key=lambda config: config.seed) for arm in arms]
    return list(dict.fromkeys(itertools.chain.from_iterable(by_seed)))


def judged(plan: Plan) -> dict[str, Comparison]:
    """Of every algorithm, M = 10 and M = 1."""
    return {name: _comparison(plan, name, {}) for name in ALGORITHMS}


def beside(plan: Plan) -> dict[str, Comparison]:
    """PPO and TRPO by the mixture's own ratio."""
    return {f"{name}, marginal": _comparison(plan, name, MARGINAL) for name in ("trpo", "ppo")}


def _comparison(plan: Plan, name: str, changes: Mapping[str, Any]) -> Comparison:
    arm = {"algorithm": name, "steps": steps(plan)}
    text = f"{name.upper()} with M = 10 beats itself with M = 1"
    envs = tuple(env for env in plan.carried if name != "naf" or env in OF_NAF)
    ours, theirs = {**arm, **MAPG, **changes}, {**arm, **DDPG}
    return Comparison((f"C10 {name.upper()}", ""), text, envs, ours, theirs)


def steps(plan: Plan) -> int:
    """Half of the others' steps, in whole turns of every algorithm."""
    ppo: Any = plan.config("pendulum", algorithm="ppo")
    turn = ppo.environments * ppo.rollout_steps
    return max(1, plan.base.steps // 2 // turn) * turn


def section(plan: Plan) -> str:
    """A table of verdicts, a picture of effects, and the scores."""
    if not scores.of(plan, runs(plan)):
        return rows.missing(runs(plan))
    everything = {**judged(plan), **beside(plan)}
    groups = {name: c.effects(c.pairs(plan)) for name, c in everything.items()}
    groups = {name: lines for name, lines in groups.items() if lines}
    text = (
        f"Each algorithm by the preset `{plan.preset}`, {steps(plan):,} steps, five seeds: "
        "M = 10 against M = 1, the plain algorithm. The head that acted is updated, as in the "
        "paper, by TRPO, PPO and TD3; in NAF the highest peak gets the gradient, in SAC every "
        "component is sampled. `marginal` is by the mixture's own ratio. Test: van Elteren's over "
        "the tasks together; p adjusted by Holm over the five algorithms, one that lacks runs "
        "counting as p = 1.\n\n" + verdict_table(plan).markdown()
    )
    if groups:
        figure = draw_forest(groups, "P, the probability of improvement of M = 10 over M = 1")
        pictures.save(plan, figure, "carryover")
        text += (
            "\n\n![Probability of improvement by algorithm and task](carryover.png)\n\n"
            "P of M = 10 over M = 1, by task and, once all of them are there, over the tasks "
            "together (diamond), with 95 % intervals over seeds; beside the task n of either arm. "
            "The dashed line is ½: neither does better. An interval of no width only means "
            "that all pairs agree; a hollow dot has none, for an arm has fewer than three seeds."
        )
    return f"{text}\n\n{score_table(plan).markdown()}"


def verdict_table(plan: Plan) -> Table:
    """One line an algorithm."""
    lines = [
        (v.claim, v.text, f"**{v.verdict}**", v.effect, v.power, v.evidence) for v in ledger(plan)
    ]
    return Table(("", "", "verdict", "effect (95 %)", "power", "evidence"), lines)


def score_table(plan: Plan) -> Table:
    """Mean scores of every arm on each task; with one head both ratios are the same."""
    lines = []
    for name, comparison in judged(plan).items():
        for label, changes in (("M = 1", comparison.theirs), ("M = 10", comparison.ours)):
            lines.append([name, label, *_score_cells(plan, comparison, changes)])
    for name, comparison in beside(plan).items():
        lines.append([name, "M = 10", *_score_cells(plan, comparison, comparison.ours)])
    return Table(("algorithm", "", *plan.carried), lines)


def _score_cells(plan: Plan, comparison: Comparison, changes: Mapping[str, Any]) -> list[str]:
    return [
        scores.of_cell(plan, plan.over_seeds(env, **changes)) if env in comparison.envs else ""
        for env in plan.carried
    ]


def ledger(plan: Plan) -> list[Verdict]:
    """A verdict for each algorithm, at Holm's level over all five."""
    found = judged(plan)
    tests = [test(plan, comparison) for comparison in found.values()]
    adjusted = holm([1.0 if t is None else t.either for t in tests])
    level = ALPHA / max(1, sum(p >= ALPHA for p in adjusted))
    return [
        _judge(plan, comparison, None if t is None else p, level)
        for comparison, t, p in zip(found.values(), tests, adjusted, strict=True)
    ]


def test(plan: Plan, comparison: Comparison) -> Test | None:
    """Over the tasks together; None while runs are missing, or where a task lacks an arm."""
    pairs = comparison.pairs(plan)
    lacking = not pairs or len(pairs) < len(comparison.envs)
    if lacking or waiting(plan, comparison.runs(plan)):
        return None
    return van_elteren(list(pairs.values()))


def _judge(plan: Plan, comparison: Comparison, p: float | None, level: float) -> Verdict:
    """At the adjusted p, None where there is no test; power is by the level that Holm leaves."""
    claim, text = comparison.claims[0], comparison.text
    if p is None:
        return Verdict(claim, text, waiting(plan, comparison.runs(plan)) or undecidable(0))
    pairs = comparison.pairs(plan)
    verdict = comparisons.together(comparison.signed(pairs), p, len(ALGORITHMS))
    chance = ""
    if verdict == UNDECIDED:
        chance = f"{power(comparisons.moved(comparison, pairs), level).together:.0%}"
    late = comparisons.second(plan, comparison, pairs)
    evidence = f"adjusted p = {p:.2g}; {comparisons.tests(comparison, pairs, late)}"
    shown = f"P {effect(list(pairs.values())):.2f}"
    return Verdict(claim, text, verdict, shown, chance, evidence)


def together(plan: Plan) -> Verdict:
    """C10: supported if M = 10 is the better one in both algorithms that the paper names."""
    of_named = [v for v, name in zip(ledger(plan), ALGORITHMS, strict=True) if name in NAMED]
    verdicts = [verdict.verdict for verdict in of_named]
    undecidable = [v for v in verdicts if v not in (SUPPORTED, CONTRADICTED, UNDECIDED)]
    found = judged(plan)
    verdict = UNDECIDED
    if left := waiting(plan, [c for name in NAMED for c in found[name].runs(plan)]):
        verdict = left
    elif CONTRADICTED in verdicts:
        verdict = CONTRADICTED
    elif undecidable:
        verdict = undecidable[0]
    elif set(verdicts) == {SUPPORTED}:
        verdict = SUPPORTED
    shown = [f"{v.claim.removeprefix('C10 ')} {v.effect}" for v in of_named if v.effect]
    evidence = "; ".join(f"{v.claim}: {v.evidence}" for v in of_named if v.evidence)
    text = "the idea carries over to NAF and TRPO: M = 10 beats M = 1 in both"
    return Verdict("C10", text, verdict, "; ".join(shown), evidence=evidence)
