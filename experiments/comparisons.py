"""Claims that one arm beats another: over their tasks together, and on each of them."""

from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from experiments import curves, rows, scores, table2
from experiments.plan import Plan
from experiments.table2 import Pair
from experiments.verdicts import CONTRADICTED, SUPPORTED, UNDECIDED, Verdict, undecidable, waiting
from mapg_jax.reports.inference import Estimate
from mapg_jax.reports.plots import TOGETHER
from mapg_jax.reports.stratified import effect, least_p, power, van_elteren
from mapg_jax.training.config import Config

ALPHA = 0.05
Changes = Mapping[str, Any]
Score = Callable[[Plan, Sequence[Config]], np.ndarray]


class Comparison(NamedTuple):
    """What a claim of two arms is about."""

    claims: tuple[str, str]
    """Its names: over the tasks together, and on each."""
    text: str
    envs: Sequence[str]
    ours: Changes
    theirs: Changes
    above: bool = True
    """Whether ours is claimed to score above theirs, or below."""
    column: str = ""
    """Ours in the paper's Table 2, if it is there; theirs is DDPG then."""

    def runs(self, plan: Plan) -> list[Config]:
        """All that it is judged on."""
        arms = (self.ours, self.theirs)
        return [c for env in self.envs for arm in arms for c in plan.over_seeds(env, **arm)]

    def missing(self, plan: Plan) -> str:
        """How many of its runs are, task by task."""
        left = {}
        for env in self.envs:
            of_env = self._replace(envs=[env]).runs(plan)
            if count := len(rows.keys(of_env)) - len(scores.of(plan, of_env)):
                left[env] = count
        return ", ".join(f"{env} {count}" for env, count in left.items())

    def pairs(self, plan: Plan, score: Score = scores.means) -> dict[str, Pair]:
        """By task; one that lacks an arm is left out."""
        found = {}
        for env in self.envs:
            ours, theirs = (plan.over_seeds(env, **arm) for arm in (self.ours, self.theirs))
            found[env] = score(plan, ours), score(plan, theirs)
        return {env: pair for env, pair in found.items() if all(map(len, pair))}

    def effects(self, pairs: Mapping[str, Pair]) -> dict[str, Estimate]:
        """By task; and of the tasks together, once all of them have both arms."""
        found = {
            f"{env} (n = {len(ours)} + {len(theirs)})": effect([(ours, theirs)])
            for env, (ours, theirs) in pairs.items()
        }
        if set(pairs) == set(self.envs):
            found[TOGETHER] = effect(list(pairs.values()))
        return found

    def signed(self, pairs: Mapping[str, Pair]) -> list[Pair]:
        """The pairs, so that the claim is that ours are above."""
        sign = 1 if self.above else -1
        return [(sign * ours, sign * theirs) for ours, theirs in pairs.values()]

    def ratio(self, env: str) -> float | None:
        """The paper's mean of ours over its mean of theirs."""
        return table2.ratio(env, self.column)


def judge(plan: Plan, comparison: Comparison) -> list[Verdict]:
    """Both forms of a claim."""
    pairs = comparison.pairs(plan)
    texts = f"{comparison.text}, over the tasks together", f"{comparison.text}, on every task"
    left = waiting(plan, comparison.runs(plan))
    if set(pairs) != set(comparison.envs):
        missing = f"runs missing: {comparison.missing(plan)}"
        verdict = left or undecidable(0)
        return [
            Verdict(claim, text, verdict, evidence=missing)
            for claim, text in zip(comparison.claims, texts, strict=True)
        ]
    signed = comparison.signed(pairs)
    verdicts = [left or together(signed), left or _each(signed)]
    chances = ["", ""]
    if UNDECIDED in verdicts:
        chances = [f"{chance:.0%}" for chance in power(moved(comparison, pairs))]
    chances = [c if v == UNDECIDED else "" for c, v in zip(chances, verdicts, strict=True)]
    late = second(plan, comparison, pairs)
    effects = {env: effect([pair]) for env, pair in pairs.items()}
    shares = "; ".join(f"{env} {shown:.2f}" for env, shown in effects.items())
    shown = f"P {effect(list(pairs.values())):.2f}", f"P: {shares}"
    evidence = tests(comparison, pairs, late), _tests_of_each(comparison, pairs, late)
    lines = zip(comparison.claims, texts, verdicts, shown, chances, evidence, strict=True)
    return [Verdict(*line) for line in lines]


def together(signed: Sequence[Pair], p: float | None = None, tests: int = 1) -> str:
    """The verdict of the stratified test.

    Args:
      signed: scores by task, so that the claim is that the first are above.
      p: adjusted, where it is one of several tests.
      tests: how many they are; the least p that can be reached is adjusted by them.
    """
    found = van_elteren(signed)
    if (found.either if p is None else p) < ALPHA:
        return SUPPORTED if found.statistic > 0 else CONTRADICTED
    sizes = [(len(ours), len(theirs)) for ours, theirs in signed]
    reachable = 2 * tests * least_p(sizes) < ALPHA
    return UNDECIDED if reachable else undecidable(min(map(min, sizes)))


def _each(signed: Sequence[Pair]) -> str:
    """The verdict of one-sided tests on every task."""
    found = [van_elteren([pair]) for pair in signed]
    if all(test.above < ALPHA for test in found):
        return SUPPORTED
    if min(test.below for test in found) < ALPHA / len(found):
        return CONTRADICTED
    sizes = [(len(ours), len(theirs)) for ours, theirs in signed]
    least = [least_p([size]) for size in sizes]
    reachable = max(least) < ALPHA or min(least) < ALPHA / len(least)
    return UNDECIDED if reachable else undecidable(min(map(min, sizes)))


def second(plan: Plan, comparison: Comparison, pairs: Mapping[str, Pair]) -> dict[str, Pair]:
    """The pairs by the second score; none unless every run that has the first has it too."""
    late = comparison.pairs(plan, curves.late)
    sizes = [{env: tuple(map(len, pair)) for env, pair in of.items()} for of in (pairs, late)]
    return late if sizes[0] == sizes[1] else {}


def moved(comparison: Comparison, pairs: Mapping[str, Pair]) -> list[Pair]:
    """Ours moved so far as the paper says, or one standard deviation within cells."""
    found = {}
    for env, (ours, theirs) in pairs.items():
        centred = ours - ours.mean()
        ratio = comparison.ratio(env)
        if ratio is None:
            within = np.concatenate([centred, theirs - theirs.mean()])
            step = np.sqrt(np.square(within).sum() / max(1, len(within) - 2))
            mean = theirs.mean() + (step if comparison.above else -step)
        else:
            mean = ratio * theirs.mean()
        found[env] = centred + mean, theirs
    return comparison.signed(found)


def tests(comparison: Comparison, pairs: Mapping[str, Pair], late: Mapping[str, Pair]) -> str:
    """p of the stratified test, by both scores, and of the paper's size."""
    texts = [f"p = {van_elteren(comparison.signed(pairs)).either:.2g}", _counts(pairs)]
    if late:
        found = van_elteren(comparison.signed(late))
        side = "above" if found.statistic > 0 else "below"
        side = side if comparison.above else {"above": "below", "below": "above"}[side]
        texts.insert(1, f"by the second score p = {found.either:.2g}, {side}")
    if size := _size(comparison, pairs):
        texts.append(size)
    if size and late:
        texts.append(f"by the second score {_size(comparison, late)}")
    return "; ".join(texts)


def _size(comparison: Comparison, pairs: Mapping[str, Pair]) -> str:
    """Whether the difference is smaller than the paper's; '' where it has no number."""
    ratios = {env: comparison.ratio(env) for env in pairs}
    if None in ratios.values():
        return ""
    scaled = {env: (ours, ratios[env] * theirs) for env, (ours, theirs) in pairs.items()}
    p = van_elteren(comparison.signed(scaled)).below
    return (
        f"{'' if p < ALPHA else 'not shown to be '}smaller than the paper's difference, p = {p:.2g}"
    )


def _tests_of_each(comparison: Comparison, pairs, late: Mapping[str, Pair]) -> str:
    """One-sided p's of every task: for the claim, and against it."""

    def line(of: Mapping[str, Pair]) -> str:
        found = {env: van_elteren(comparison.signed({env: pair})) for env, pair in of.items()}
        return "; ".join(
            f"{env} {test.above:.3g} / {test.below:.3g}" for env, test in found.items()
        )

    level = f"one against below {ALPHA / len(comparison.envs):.3g} contradicts"
    text = f"p for / against ({level}): {line(pairs)}"
    return f"{text}. By the second score: {line(late)}" if late else text


def _counts(pairs: Mapping[str, Pair]) -> str:
    """Seeds of both arms on each task."""
    counts = [f"{env} {len(ours)} + {len(theirs)}" for env, (ours, theirs) in pairs.items()]
    return f"n = {', '.join(counts)}"
