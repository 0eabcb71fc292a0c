"""The ledger: every claim of the paper, the evidence, and a verdict by experiments/protocol.md."""

from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from experiments import fig2, fig3, fig4, heads, overhead, scores, table2, torcs
from experiments.plan import A3C, DDPG, MAPG, NO_NOISE, Plan
from mapg_jax.reports import inference as statistics
from mapg_jax.reports.document import Table
from mapg_jax.training.config import Config

SUPPORTED, CONTRADICTED = "supported", "contradicted"
UNDECIDED, NOT_TESTED = "undecided", "not tested"
Changes = Mapping[str, Any]


class Verdict(NamedTuple):
    """One line of the ledger."""

    claim: str
    text: str
    evidence: str
    verdict: str


def runs(plan: Plan) -> list[Config]:
    """All of the other experiments'."""
    return [config for module in (table2, fig2, fig4, torcs, heads) for config in module.runs(plan)]


def section(plan: Plan) -> str:
    """The ledger as a table."""
    lines = [(v.claim, v.text, v.evidence, f"**{v.verdict}**") for v in ledger(plan)]
    return Table(("", "claim", "evidence", "verdict"), lines).markdown() + (
        "\n\nP is the probability of improvement: the share of pairs of seeds in which the first "
        "named scores higher, with its 95 % interval over seeds (wider where one task of several "
        "is enough to contradict); n counts seeds. A verdict needs three seeds in every cell it "
        "uses, but for C7, which is timed in rounds. Where two arms are compared (C1, C2b, C5, C9) "
        "it needs an exact rank-sum test beside the interval, which no three seeds against three "
        "can pass. C6 is judged by its shares, as the protocol says; their mean has the interval."
    )


def pairwise(
    plan: Plan,
    claim: str,
    text: str,
    envs: Sequence[str],
    ours: Changes,
    theirs: Changes,
    claimed: str = "above",
) -> Verdict:
    """A claim that one arm scores above (or below) another on every one of several tasks."""
    tasks = {}
    for env in envs:
        y, x = (scores.means(plan, plan.over_seeds(env, **arm)) for arm in (ours, theirs))
        if len(y) and len(x):
            comparisons = [statistics.compare(y, x, level) for level in _levels(envs)]
            estimates = [(c.improvement, c.verdict) for c in comparisons]
            tasks[env] = Task(estimates[0], estimates[1], f"n = {len(y)}, {len(x)}")
    return over_tasks(claim, text, "P", envs, tasks, claimed)


class Task(NamedTuple):
    """An estimate on one task and its side of the null, at 95 % and at the wider level."""

    narrow: tuple[statistics.Estimate, str]
    wide: tuple[statistics.Estimate, str]
    seeds: str


def over_tasks(
    claim: str,
    text: str,
    statistic: str,
    envs: Sequence[str],
    tasks: Mapping[str, Task],
    claimed: str,
) -> Verdict:
    """Every task must be on the claimed side; one on the other, at the wider level, contradicts."""
    opposite = {"above": "below", "below": "above"}[claimed]
    verdict = UNDECIDED
    if len(tasks) == len(envs) and all(task.narrow[1] == claimed for task in tasks.values()):
        verdict = SUPPORTED
    elif any(task.wide[1] == opposite for task in tasks.values()):
        verdict = CONTRADICTED
    evidence = []
    for env in envs:
        if env in tasks:
            task = tasks[env]
            estimate = (task.wide if verdict == CONTRADICTED else task.narrow)[0]
            evidence.append(f"{env} {estimate:.3g}, {task.seeds}")
        else:
            evidence.append(f"{env} missing")
    return Verdict(claim, text, f"{statistic}: " + "; ".join(evidence), verdict)


def c1(plan: Plan) -> Verdict:
    text = "M = 10 beats DDPG on every task"
    return pairwise(plan, "C1", text, plan.tasks, MAPG, DDPG)


def c2a(plan: Plan) -> Verdict:
    """The rank correlation of score with M, on two tasks."""
    envs, tasks = ("hopper", "walker2d"), {}
    for env in envs:
        groups = {m: scores.means(plan, plan.over_seeds(env, heads=m)) for m in (1, *plan.heads)}
        seeds = min(map(len, groups.values()))
        groups = {m: of_m for m, of_m in groups.items() if len(of_m)}
        if len(groups) < 2:
            continue
        estimates = [(statistics.spearman(groups, level), level) for level in _levels(envs)]
        sides = [(e, statistics.verdict(e, 0.0, seeds, level=level)) for e, level in estimates]
        counts = ", ".join(f"M = {m}: {len(x)}" for m, x in groups.items())
        tasks[env] = Task(sides[0], sides[1], f"n of {counts}")
    text = "the score grows with M on Hopper and Walker2d"
    return over_tasks("C2a", text, "rank correlation", envs, tasks, "above")


def c2b(plan: Plan) -> Verdict:
    envs = [env for env in plan.tasks if env != "humanoid"]
    text = "M = 5 beats DDPG on all but Humanoid"
    return pairwise(plan, "C2b", text, envs, {"heads": 5}, DDPG)


def c3(plan: Plan) -> Verdict:
    found = fig2.statistics_by_seed(plan)
    n = len(found.spikes)
    step, reward, spikes = (statistics.student(values) for values in found)
    correlations = [statistics.verdict(e, 0.0, n) for e in (step, reward)]
    verdict = UNDECIDED
    if correlations == ["below", "below"] and statistics.verdict(spikes, 2.0, n) == "above":
        verdict = SUPPORTED
    elif "above" in correlations:
        verdict = CONTRADICTED
    evidence = (
        f"rank correlation of spread with step {step:.3g}, with return {reward:.3g}; "
        f"largest over median spread of the second half {spikes:.3g}; "
        f"{_count(*found)}"
    )
    text = "the spread of the actions falls as the return rises, with spikes that stay"
    return Verdict("C3", text, evidence, verdict)


def c4(plan: Plan) -> Verdict:
    spread = {k: np.array(v) for k, v in fig3.spread_by_seed(plan).items()}
    n = len(spread["upright"])
    with np.errstate(divide="ignore", invalid="ignore"):  # no spread, no ratio
        ratio = np.log(spread["hanging"] / spread["between"])
    peak = statistics.student(ratio)
    top = statistics.student(spread["upright"])
    sides = [statistics.verdict(peak, 0.0, n), statistics.verdict(top, 0.02, n)]
    verdict = UNDECIDED
    if sides == ["above", "above"]:
        verdict = SUPPORTED
    elif "below" in sides:
        verdict = CONTRADICTED
    evidence = (
        f"log ratio of the spread near 0° to that at 30° to 150° {peak:.3g}; "
        f"spread beyond 150° {top:.3g}; {_count(ratio, spread['upright'])}"
    )
    text = "the spread peaks as the pendulum hangs down and stays above 0 upright"
    return Verdict("C4", text, evidence, verdict)


def c5a(plan: Plan) -> Verdict:
    text = "M = 10 without noise explores as well as DDPG with it"
    return pairwise(plan, "C5a", text, plan.studied, {**MAPG, **NO_NOISE}, DDPG)


def c5b(plan: Plan) -> Verdict:
    text = "with noise M = 10 beats DDPG"
    return pairwise(plan, "C5b", text, plan.studied, MAPG, DDPG)


def c6a(plan: Plan) -> Verdict:
    shares = _lap_shares(plan, MAPG)
    most = len(shares) / 2
    verdict = UNDECIDED
    if len(shares) >= statistics.LEAST_SEEDS:
        if sum(share >= 0.5 for share in shares) > most:
            verdict = SUPPORTED
        elif sum(share == 0 for share in shares) > most:
            verdict = CONTRADICTED
    return Verdict("C6a", "driving: M = 10 completes laps", _shares(shares), verdict)


def c6b(plan: Plan) -> Verdict:
    shares = _lap_shares(plan, DDPG)
    verdict = UNDECIDED
    if len(shares) >= statistics.LEAST_SEEDS:
        if max(shares) == 0:
            verdict = SUPPORTED
        elif max(shares) >= 0.5:
            verdict = CONTRADICTED
    return Verdict("C6b", "driving: DDPG completes none", _shares(shares), verdict)


def c7(plan: Plan) -> Verdict:
    ratios = overhead.ratios(plan, "seconds_per_step").get(10, [])
    estimate = statistics.student(ratios)
    side = statistics.verdict(estimate, 1.5, len(ratios)) if len(ratios) >= 7 else UNDECIDED
    verdict = {"below": SUPPORTED, "above": CONTRADICTED}.get(side, UNDECIDED)
    evidence = f"time of a training step, M = 10 over M = 1: {estimate:.3g}, {len(ratios)} rounds"
    return Verdict("C7", "M costs little time", evidence, verdict)


def c8(plan: Plan) -> Verdict:
    tasks = {}
    for env in plan.tasks:
        gaps = heads.gap_by_seed(plan, env)
        if gaps:
            estimates = [(statistics.student(gaps, level), level) for level in _levels(plan.tasks)]
            sides = [(e, statistics.verdict(e, 0.1, len(gaps), level=lv)) for e, lv in estimates]
            tasks[env] = Task(sides[0], sides[1], _count(gaps))
    text = "all proposals of an optimal policy have the same expected return"
    return over_tasks("C8", text, "Q-gap over std of Q", plan.tasks, tasks, "below")


def c9(plan: Plan) -> Verdict:
    text = "A3C does worse than DDPG on every task"
    return pairwise(plan, "C9", text, plan.tasks, A3C, DDPG, claimed="below")


def c10(_: Plan) -> Verdict:
    return Verdict("C10", "the idea carries over to NAF and TRPO", "", NOT_TESTED)


JUDGES: tuple[Callable[[Plan], Verdict], ...] = (
    c1, c2a, c2b, c3, c4, c5a, c5b, c6a, c6b, c7, c8, c9, c10,
)  # fmt: skip


def ledger(plan: Plan) -> list[Verdict]:
    """All verdicts, C1 to C10."""
    return [judge(plan) for judge in JUDGES]


def _levels(envs: Sequence[str]) -> tuple[float, float]:
    """Of the intervals: to support a claim, and for one of several tasks to contradict it."""
    return 0.95, 1 - 0.05 / len(envs)


def _count(*numbers) -> str:
    """How many seeds, and how many of them lack one of their numbers."""
    without = int((~np.isfinite(np.array(numbers)).all(axis=0)).sum())
    text = f"n = {len(numbers[0])}"
    return f"{text}, {without} of them without such a number" if without else text


def _lap_shares(plan: Plan, changes: Changes) -> list[float]:
    """Of every seed, the share of the episodes that complete a lap."""
    found = scores.of(plan, torcs.arm(plan, changes))
    return [result.lap_share for result in found if result.lap_share is not None]


def _shares(shares: Sequence[float]) -> str:
    if not shares:
        return "episodes with a lap: missing"
    listed = ", ".join(f"{share:.0%}" for share in shares)
    mean = statistics.mean(shares)
    return f"episodes with a lap, by seed: {listed}; mean {mean:.3g}; n = {len(shares)}"
