"""Driving, the stand-in for TORCS: distance and laps over 100 episodes (C6)."""

from collections.abc import Sequence

import numpy as np

from experiments import scores
from experiments.plan import DDPG, DRIVING, MAPG, Plan
from mapg_jax.config import Config
from mapg_jax.results import Result

ARMS = {"DDPG": DDPG, "MAPG, M = 10": MAPG}
PAPER = {"DDPG": 807, "MAPG, M = 10": 5882}
"""m, mean distance of an episode (section 4.5), on another track, without a time limit stated."""


def runs(plan: Plan) -> list[Config]:
    return [config for changes in ARMS.values() for config in arm(plan, changes)]


def arm(plan: Plan, changes) -> list[Config]:
    """One algorithm over all seeds."""
    return plan.over_seeds("driving", **DRIVING, **changes)


def section(plan: Plan) -> str:
    """Distance and laps, seed by seed."""
    lines = [
        "| | seed | distance, m | laps | episodes with a lap | return | the paper, m |",
        "|---|---|---|---|---|---|---|",
    ]
    for label, changes in ARMS.items():
        found = scores.of(plan, arm(plan, changes))
        lines += [_line(label, PAPER[label], [result]) for result in found]
        lines.append(_line(f"**{label}**", PAPER[label], found))
    options = ", ".join(DRIVING["env_options"])
    return "\n".join(lines) + (
        f"\n\nMeans of 100 episodes, each of at most {DRIVING['time_limit']} steps (200 s), on "
        f"`speedway` (1996 m; {options}: docs/driving.md says how they were chosen). The paper "
        "drove another track in TORCS: compare the signs, not the metres."
    )


def _line(label: str, paper: int, found: Sequence[Result]) -> str:
    if not found:
        return f"| {label} | | missing | | | | {paper} |"
    seeds = str(found[0].seed) if len(found) == 1 and "*" not in label else f"n = {len(found)}"
    numbers = np.mean(
        [
            [getattr(r, c) for c in ("distance_mean", "laps_mean", "lap_share", "return_mean")]
            for r in found
        ],
        0,
    )
    distance, laps, share, score = numbers
    return (
        f"| {label} | {seeds} | {distance:.0f} | {laps:.1f} | {share:.0%} | {score:.0f} | {paper} |"
    )
