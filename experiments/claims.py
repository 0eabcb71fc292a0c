"""The ledger: every claim of the paper, the evidence, and a verdict by experiments/protocol.md."""

import math
from collections.abc import Callable, Sequence

import numpy as np

from experiments import (
    carryover,
    curves,
    fig2,
    fig3,
    growth,
    overhead,
    returns,
    rows,
    scores,
    torcs,
)
from experiments.comparisons import ALPHA, Comparison, judge
from experiments.plan import A3C, DDPG, MAPG, NO_NOISE, Plan
from experiments.verdicts import (
    CONTRADICTED,
    SUPPORTED,
    UNDECIDED,
    Verdict,
    by_seeds,
    count,
    undecidable,
    waiting,
)
from mapg_jax.reports import inference as statistics
from mapg_jax.reports.document import Table
from mapg_jax.reports.stratified import SIMULATIONS, effect, least_p, van_elteren
from mapg_jax.training.config import Config

EARLIER = "version_1/claims.csv"
"""Verdicts of version 1, as they were recorded."""
EARLIER_NAMES = {"C1b": "C1", "C4a": "C4", "C4b": "C4"}
"""Of claims that version 1 called otherwise; it tested each task, and none together."""
ROUNDS = 7
SAME = 0.1
"""Scatter between heads, over that between actions at random, below which they return the same."""


def runs(plan: Plan) -> list[Config]:
    """What the claims are judged on; C7 is timed."""
    of_two = [config for comparison in comparisons(plan) for config in comparison.runs(plan)]
    modules = (growth, fig2, fig3, torcs, returns)
    rest = [config for module in modules for config in module.runs(plan)]
    carried = [config for arm in carryover.judged(plan).values() for config in arm.runs(plan)]
    return list(dict.fromkeys([*of_two, *rest, *carried]))


def section(plan: Plan) -> str:
    """The ledger as a table, and the evidence line by line."""
    found = ledger(plan)
    lines = [
        (v.claim, v.text, earlier(plan, v.claim), f"**{v.verdict}**", v.effect, v.power)
        for v in found
    ]
    header = ("", "claim", "version 1", "version 2", "effect (95 %)", "power")
    evidence = "\n".join(f"- {v.claim}: {v.evidence}." for v in found if v.evidence)
    return (
        f"{Table(header, lines).markdown()}\n\n"
        "P is the probability of improvement: the share of pairs of seeds in which the first named "
        "scores higher, with its 95 % interval over seeds. Of five to eight seeds that interval is "
        "a little too short (one of no width only means that all pairs agree): where it leaves out "
        "½ and p is not small, p decides. Power, of what is undecided: how often the rule would "
        "say supported if the paper's ratios of means were true (or, where it has none, one "
        "standard deviation lay between two arms, or C8's ratio were 0), by the scatter seen. "
        "Where that is a few per cent, so many seeds could hardly have supported the claim: "
        "undecided then only says that they do not contradict it. P over tasks is weighed as the "
        "test weighs them. "
        "The spread is the standard deviation of the M proposals at a state, in a range of "
        "[-1, 1]; the second score is the mean of a run's last ten evaluations; n counts the seeds "
        "of both arms, task by task. Claims share runs (C1, C5 and C9 those of DDPG), and are not "
        "independent of each other; each is judged by itself at 5 %, so that one verdict of twenty "
        "may be chance. Version 1 judged its own runs by its own rules; no number here averages "
        "both.\n\n"
        f"{evidence}"
    )


def ledger(plan: Plan) -> list[Verdict]:
    """All verdicts, C1 to C10."""
    found = [judge(plan, comparison) for comparison in comparisons(plan)]
    c1, c2b, c5a, c5b, c9 = found
    single = [judge_one(plan) for judge_one in JUDGES]
    c2a, c3, c4a, c4b, c6a, c6b, c7, c8, c10 = single
    return [
        *c1, c2a, *c2b, c3, c4a, c4b, *c5a, *c5b, c6a, c6b, c7, c8, *c9, c10,
    ]  # fmt: skip


def comparisons(plan: Plan) -> list[Comparison]:
    """The claims of two arms."""
    most = [env for env in plan.tasks if env != "humanoid"]
    return [
        Comparison(("C1a", "C1b"), "M = 10 beats DDPG", plan.tasks, MAPG, DDPG, column="M = 10"),
        Comparison(
            ("C2b together", "C2b each"), "M = 5 beats DDPG but on Humanoid",
            most, {"heads": 5}, DDPG,
        ),
        Comparison(
            ("C5a together", "C5a each"), "M = 10 without noise explores as well as DDPG with it",
            plan.studied, {**MAPG, **NO_NOISE}, DDPG,
        ),
        Comparison(
            ("C5b together", "C5b each"), "with noise M = 10 beats DDPG",
            plan.studied, MAPG, DDPG, column="M = 10",
        ),
        Comparison(
            ("C9 together", "C9 each"), "A3C does worse than DDPG",
            plan.tasks, A3C, DDPG, above=False, column="A3C",
        ),
    ]  # fmt: skip


def c3(plan: Plan) -> Verdict:
    """Of the learning phase, and of the spikes after it."""
    found = fig2.by_seed(plan)
    n = len(found.spikes)
    step, reward, spikes, raw, over_levels = (statistics.student(values) for values in found)
    text = "the spread of the actions falls while the return rises, with spikes that stay"
    parts = {
        "that it falls": _side(step, -1),
        "that it falls as the return rises": _side(reward, -1),
        "that spikes stay": _side(spikes, 1),
    }
    sides = list(parts.values())
    verdict = waiting(plan, fig2.runs(plan), curves.FILE) or by_seeds(
        n, set(sides) == {SUPPORTED}, CONTRADICTED in sides[:2]
    )
    effect = (
        f"rank correlation of spread with step {step:.2f}, with return, detrended, {reward:.2f}; "
        f"log of the highest spike over chance {spikes:.2f}"
    )
    judged = "; ".join(f"{part}: {side}" for part, side in parts.items())
    beside = f"with return as it is {raw:.2f}, the highest spike over noise {over_levels:.2f}"
    evidence = f"{judged}; beside it, which decides nothing: {beside}; {count(*found)}"
    return Verdict("C3", text, verdict, effect if n else "", evidence=evidence if n else "")


def _side(estimate: statistics.Estimate, claimed: int) -> str:
    """Where a number's interval lies, whose sign is claimed."""
    if estimate.low <= 0 <= estimate.high or not math.isfinite(estimate.low):
        return UNDECIDED
    return SUPPORTED if math.copysign(1, estimate.low) == claimed else CONTRADICTED


def c4a(plan: Plan) -> Verdict:
    """Where the spread peaks."""
    ratio = _peak(plan, fig3.judged(plan))
    peak = statistics.student(ratio)
    verdict = waiting(plan, fig3.judged(plan), fig3.BINS) or by_seeds(
        len(ratio), peak.low > 0, peak.high < 0
    )
    text = "within an episode the spread peaks as the pendulum hangs down"
    effect = f"log ratio of the spread near 0° to that at 30° to 150° {peak:.2f}"
    if not len(ratio):
        return Verdict("C4a", text, verdict)
    floor = statistics.student(_peak(plan, fig3.floor(plan)))
    evidence = f"{count(ratio)}; with gradient all, which decides nothing, {floor:.2f}"
    return Verdict("C4a", text, verdict, effect, evidence=evidence)


def _peak(plan: Plan, runs: Sequence[Config]) -> np.ndarray:
    """Of every seed, the log ratio of the spread as the pendulum hangs to that on the way up."""
    spread = {k: np.array(v) for k, v in fig3.spread_by_seed(plan, runs).items()}
    with np.errstate(divide="ignore", invalid="ignore"):  # no spread, no ratio
        return np.log(spread["hanging"] / spread["between"])


def c4b(plan: Plan) -> Verdict:
    """Whether there is more spread at the top than is left without a reason."""
    text = "the spread stays above 0 as the pendulum stands upright"
    arms = [
        fig3.spread_by_seed(plan, of)["upright"] for of in (fig3.judged(plan), fig3.floor(plan))
    ]
    left = waiting(plan, fig3.runs(plan), fig3.BINS)
    found = [np.array(arm) for arm in arms]
    if not all(len(arm) and np.isfinite(arm).all() for arm in found):
        return Verdict("C4b", text, left or undecidable(0))
    test = van_elteren([(found[0], found[1])])
    sizes = len(found[0]), len(found[1])
    decided = SUPPORTED if test.statistic > 0 else CONTRADICTED
    reachable = UNDECIDED if 2 * least_p([sizes]) < ALPHA else undecidable(min(sizes))
    verdict = left or (decided if test.either < ALPHA else reachable)
    means = [statistics.student(arm) for arm in found]
    shown = f"mean spread beyond 150° {means[0]:.2g}, with gradient all {means[1]:.2g}"
    improvement = effect([(found[0], found[1])])
    evidence = f"p = {test.either:.2g}; P {improvement:.2f}; n = {sizes[0]} + {sizes[1]}"
    return Verdict("C4b", text, verdict, shown, evidence=evidence)


def c6a(plan: Plan) -> Verdict:
    shares = _lap_shares(plan, MAPG)
    most = len(shares) / 2
    verdict = waiting(plan, torcs.arm(plan, MAPG)) or by_seeds(
        len(shares),
        sum(share >= 0.5 for share in shares) > most,
        sum(share == 0 for share in shares) > most,
    )
    return Verdict("C6a", "driving: M = 10 completes laps", verdict, *_shares(shares))


def c6b(plan: Plan) -> Verdict:
    shares = _lap_shares(plan, DDPG)
    most = max(shares, default=math.nan)
    verdict = waiting(plan, torcs.arm(plan, DDPG)) or by_seeds(len(shares), most == 0, most >= 0.5)
    return Verdict("C6b", "driving: DDPG completes none", verdict, *_shares(shares))


def c7(plan: Plan) -> Verdict:
    ratios = overhead.ratios(plan, "seconds_per_step").get(10, [])
    estimate = statistics.student(ratios)
    verdict = f"not yet: {len(ratios)} of {ROUNDS} rounds"
    if len(ratios) >= ROUNDS:
        verdict = by_seeds(len(ratios), estimate.high < 1.5, estimate.low > 1.5)
    effect = f"time of a training step, M = 10 over M = 1: {estimate:.2f}" if len(ratios) else ""
    return Verdict("C7", "M costs little time", verdict, effect)


def c8(plan: Plan) -> Verdict:
    """On every task below a tenth; one above contradicts."""
    found = {env: returns.ratios(plan, env) for env in plan.tasks}
    estimates = {env: statistics.student(ratios) for env, ratios in found.items()}
    below = all(estimate.high < SAME for estimate in estimates.values())
    above = any(statistics.student(ratios, 0.99).low > SAME for ratios in found.values())
    left = waiting(plan, returns.runs(plan), returns.FILE)
    verdict = left or by_seeds(min(map(len, found.values())), below, above)
    text = "all proposals of an optimal policy have the same expected return"
    shown = [
        f"{env} {estimates[env]:.2g}, {count(of)}, {of.count(0.0)} of them 0"
        for env, of in found.items()
        if of
    ]
    effect = f"scatter between heads over that between actions at random: {'; '.join(shown)}"
    chance = f"{_power_of_the_same(list(found.values())):.0%}" if verdict == UNDECIDED else ""
    return Verdict("C8", text, verdict, effect if shown else "", chance)


def _power_of_the_same(found: Sequence[Sequence[float]]) -> float:
    """How often C8 would be supported if the ratio's mean were 0 on every task.

    Args:
      found: ratios of each task; as many are drawn from them with replacement, moved to that mean.
        Their scatter stays, which is wider where seeds differ than it would be of equal heads.
    """
    rng = np.random.default_rng(0)
    same = np.ones(SIMULATIONS, bool)
    for ratios in found:
        centred = np.array(ratios) - np.mean(ratios)
        drawn = rng.choice(centred, (SIMULATIONS, len(centred)))
        same &= [statistics.student(of_one).high < SAME for of_one in drawn]
    return float(same.mean())


JUDGES: tuple[Callable[[Plan], Verdict], ...] = (
    growth.c2a,
    c3,
    c4a,
    c4b,
    c6a,
    c6b,
    c7,
    c8,
    carryover.together,
)
"""Of the claims that are not of two arms."""


def earlier(plan: Plan, claim: str) -> str:
    """Version 1's verdict of the claim, or of the whole that it is a half of."""
    found = rows.read(plan.results / EARLIER, ("claim", "verdict"))
    verdicts = {row["claim"]: row["verdict"] for row in found}
    name = claim.removesuffix(" each")
    name = EARLIER_NAMES.get(name, name)
    if name not in verdicts:
        return "not tested" if verdicts else ""
    halves = sum(name == other for other in EARLIER_NAMES.values()) > 1
    return f"{verdicts[name]}, as one {name}" if halves else verdicts[name]


def _lap_shares(plan: Plan, changes) -> list[float]:
    """Of every seed, the share of the episodes that complete a lap."""
    found = scores.of(plan, torcs.arm(plan, changes))
    if without := [result.seed for result in found if "lap_share" not in result.metrics]:
        raise ValueError(
            f"{scores.path(plan)}: driving, seed {without[0]} has no lap_share; leave it out"
        )
    return [result.metrics["lap_share"] for result in found]


def _shares(shares: Sequence[float]) -> tuple[str, str, str]:
    """Effect, no power, and evidence."""
    if not shares:
        return "", "", ""
    listed = ", ".join(f"{share:.0%}" for share in shares)
    shown = f"mean share of episodes with a lap {statistics.student(shares):.2f}"
    return shown, "", f"episodes with a lap, by seed: {listed}; n = {len(shares)}"
