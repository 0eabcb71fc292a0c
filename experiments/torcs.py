"""Driving, the stand-in for TORCS: distance and laps over 100 episodes (C6)."""

from collections.abc import Sequence

from experiments import scores
from experiments.plan import DDPG, DRIVING, MAPG, Plan
from mapg_jax.reports import inference as statistics
from mapg_jax.reports.document import Table
from mapg_jax.reports.results import Result
from mapg_jax.training.config import Config

ARMS = {"DDPG": DDPG, "MAPG, M = 10": MAPG}
PAPER = {"DDPG": 807, "MAPG, M = 10": 5882}
"""m, mean distance of an episode (section 4.5), on another track, without a time limit stated."""
HEADER = ("", "seed", "distance, m", "laps", "episodes with a lap", "return", "the paper, m")


def runs(plan: Plan) -> list[Config]:
    return [config for changes in ARMS.values() for config in arm(plan, changes)]


def arm(plan: Plan, changes) -> list[Config]:
    """One algorithm over all seeds."""
    return plan.over_seeds("driving", **DRIVING, **changes)


def section(plan: Plan) -> str:
    """Distance and laps, seed by seed."""
    lines = []
    for label, changes in ARMS.items():
        found = scores.of(plan, arm(plan, changes))
        lines += [_seed(label, result) for result in found]
        lines.append(_mean(label, found))
    options = ", ".join(DRIVING["env_options"])
    return Table(HEADER, lines).markdown() + (
        f"\n\nMeans of {plan.base.final_episodes} episodes, each of at most "
        f"{DRIVING['time_limit']} steps (200 s), on `speedway` (1996 m; {options}: docs/driving.md "
        "says how they were chosen); in the bold lines the mean over n seeds, with "
        "Student's 95 % interval. The paper drove another track in TORCS: compare the signs, not "
        "the metres."
    )


def _seed(label: str, result: Result) -> list[str]:
    return [
        label,
        str(result.seed),
        f"{result.metrics['distance_mean']:.0f}",
        f"{result.metrics['laps_mean']:.1f}",
        f"{result.metrics['lap_share']:.0%}",
        f"{result.return_mean:.0f}",
        "",
    ]


def _mean(label: str, found: Sequence[Result]) -> list[str]:
    if not found:
        return [f"**{label}**", "", "missing", "", "", "", str(PAPER[label])]
    columns = [[r.metrics[c] for r in found] for c in ("distance_mean", "laps_mean", "lap_share")]
    distance, laps, share = map(statistics.student, columns)
    score = statistics.student([result.return_mean for result in found])
    return [
        f"**{label}**",
        f"n = {len(found)}",
        f"{distance:.0f}",
        f"{laps:.1f}",
        f"{share:.0%}",
        f"{score:.0f}",
        str(PAPER[label]),
    ]
