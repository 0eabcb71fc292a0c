"""python -m benchmarks.reach: the wall time to a given return, beside the peers' best settings.

It goes on where it was stopped (`reach_runs`), and makes a section of benchmarks/results.md of all
that has been run.
"""

import argparse
import math
import signal
import statistics
import sys
from collections.abc import Sequence
from typing import NamedTuple

from benchmarks import page, reach_runs
from benchmarks.learning import PEERS
from benchmarks.reach_runs import Learner, Result
from mapg_jax.reports import document

TITLE = "## Wall time to a given return"


class Cell(NamedTuple):
    """A learner on a task, over its seeds."""

    learner: Learner
    seconds: Sequence[float]
    env_steps: float
    """Median of those that reached; nan if none did."""
    limit: float

    @property
    def median(self) -> float:
        """Infinite where most have not reached."""
        return statistics.median(self.seconds)


def cells(task: str, found: Sequence[Result]) -> list[Cell]:
    """Of the learners that go on, shortest first."""
    of_task = [
        (learner, [x for x in found if (x.task, x.learner) == (task, learner.name)])
        for learner in reach_runs.kept(task, found)
    ]
    made = [
        Cell(
            learner,
            sorted(x.seconds for x in runs),
            statistics.median([x.env_steps for x in runs if x.reached] or [math.nan]),
            max(x.limit for x in runs),
        )
        for learner, runs in of_task
        if runs
    ]
    return sorted(made, key=lambda cell: cell.median)


def table(task: str, found: Sequence[Result]) -> document.Table:
    """A row a learner."""
    rows = [
        (
            cell.learner.name,
            _range(cell),
            f"{sum(map(math.isfinite, cell.seconds))} of {len(cell.seconds)}",
            f"{cell.env_steps:,.0f}" if math.isfinite(cell.env_steps) else "",
            cell.learner.settings,
        )
        for cell in cells(task, found)
    ]
    header = ("", "s, median (smallest to largest)", "reached", "environment steps", "settings")
    return document.Table(header, rows)


def _range(cell: Cell) -> str:
    low, *_, high = [cell.seconds[0], *cell.seconds]
    median = _seconds(cell.median, cell.limit)
    if len(cell.seconds) == 1 or not math.isfinite(low):
        return median
    return f"{median} ({_seconds(low, cell.limit)} to {_seconds(high, cell.limit)})"


def _seconds(seconds: float, limit: float) -> str:
    return f"{seconds:,.1f}" if math.isfinite(seconds) else f"over {limit:g}"


def verdict(task: str, found: Sequence[Result]) -> str:
    """Who is the shortest, and by what: the steps that it takes, or their speed."""
    of_task = cells(task, found)
    own = next((cell for cell in of_task if cell.learner.heads), None)
    other = next((cell for cell in of_task if not cell.learner.heads), None)
    if own is None or other is None:
        return "Not all of it has been run yet."
    first, second = (own, other) if own.median <= other.median else (other, own)
    whose = "the peers'" if first is own else "ours"
    if not math.isfinite(first.median):
        return "Nobody reaches it by most seeds."
    shortest = f"The shortest is {first.learner.name}, {first.median:,.1f} s"
    if not math.isfinite(second.median):
        return f"{shortest}; none of {whose} reaches it by most seeds."
    steps = second.env_steps / first.env_steps
    times = second.median / first.median
    return (
        f"{shortest}; {second.learner.name}, the shortest of {whose}, takes {times:.1f} times as "
        f"long: {steps:.2g} times the environment steps, {steps / times:.2g} times as many a "
        "second."
    )


def tried(task: str, found: Sequence[Result]) -> str:
    """All of ours with the first seed."""
    first = {x.learner: x for x in found if x.task == task and x.seed == reach_runs.SEEDS[0]}
    own = [
        f"{learner.name} ({learner.settings}) {_seconds(result.seconds, result.limit)}"
        for learner in reach_runs.LEARNERS[task]
        if learner.heads and (result := first.get(learner.name))
    ]
    return f"Of ours there were tried, with seed {reach_runs.SEEDS[0]}, s: {'; '.join(own)}."


def report() -> str:
    """The section of the page, of what has been run so far; nothing is run for it."""
    found = reach_runs.results(reach_runs.FILE)
    if not found:
        return f"{TITLE}\n\nnot measured: `python -m benchmarks.reach` does"
    blocks: list[document.Block] = [
        document.Paragraph(
            "Seconds from the start of the process to the end of its first evaluation, ten "
            "episodes, whose mean return is the target at least: imports, compiling (nothing was "
            "compiled before) and evaluations included, one thread each. Evaluations are about a "
            "second of training apart on Pendulum, five to ten on the others; of short rollouts "
            "as many environment steps as those of the peers' PPO. Medians of seeds "
            f"{', '.join(map(str, reach_runs.SEEDS))}; a run that has not reached its target when "
            "its time is up counts as longer than all that have. Peers have the settings that are "
            "published for them; rejax is there on Pendulum alone, since its other tasks are "
            "Brax's and not MuJoCo's. Of ours the two go on that were the fastest with seed "
            f"{reach_runs.SEEDS[0]}, one of them with M = {reach_runs.HEADS}; that seed is in "
            "their medians too, which flatters them a little. So it does that short rollouts were "
            "chosen among a handful of sizes, rates and epochs tried with these seeds and 100 to "
            "103; their γ and λ, and on Pendulum their rates, are the peers'. `python -m "
            "benchmarks.reach` goes on with what is missing."
        )
    ]
    for task, (target, limit) in reach_runs.TASKS.items():
        if any(result.task == task for result in found):
            blocks += [
                document.Heading(f"{task}, {target:,g} within {limit:g} s", 3),
                table(task, found),
                document.Paragraph(verdict(task, found)),
                document.Paragraph(tried(task, found)),
            ]
    return f"{TITLE}\n\n{document.markdown(blocks).rstrip()}"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--no-train", action="store_true", help="only make the section")
    parser.add_argument(
        "--only", nargs="+", choices=list(reach_runs.TASKS), help="run these tasks alone"
    )
    parser.add_argument("--workers", type=int, default=1, help="runs side by side")
    arguments = parser.parse_args()
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(128 + signal.SIGTERM))  # ends its runs too
    if not arguments.no_train:
        if not PEERS.exists():
            parser.error("the peers are not installed; `make bench-peers` does")
        reach_runs.train(arguments.only or list(reach_runs.TASKS), arguments.workers)
    page.renew(report())


if __name__ == "__main__":
    main()
