"""Where several actions pay, and what they cost: where several are good, and where one is."""

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from envs.bandits.bandits import NEAR
from experiments import pictures, rows, scores
from experiments.plan import DDPG, MAPG, Plan
from mapg_jax.algorithms.head_options import DIVERSE
from mapg_jax.reports import inference as statistics
from mapg_jax.reports.document import Table
from mapg_jax.reports.plots import draw_shares
from mapg_jax.reports.stratified import effect, van_elteren
from mapg_jax.training.config import Config

GAUSSIAN: Mapping[str, Any] = {"noise": "gaussian", "noise_scale": 0.1}
ARMS: Mapping[str, Mapping[str, Any]] = {
    "DDPG": {**DDPG, **GAUSSIAN},
    "M = 10": {**MAPG, **GAUSSIAN},
    "diverse": {**MAPG, **GAUSSIAN, **DIVERSE},
    "TD3": {"algorithm": "td3", **DDPG},
    "TD3, M = 10": {"algorithm": "td3", **MAPG},
    "TD3, diverse": {"algorithm": "td3", **MAPG, **DIVERSE},
    "SAC": {"algorithm": "sac", **DDPG},
    "SAC, M = 10": {"algorithm": "sac", **MAPG},
}
DETERMINISTIC = ("DDPG", "M = 10", "diverse")
"""The paper's algorithms, and heads kept apart."""
SHOWN = (*DETERMINISTIC, "SAC")
"""In the picture."""
ONE_BEST = ("pendulum", "halfcheetah", "hopper", "walker2d")
"""Tasks where one action is the best, and keeping heads apart can only cost."""
COMPARED: Mapping[str, tuple[str, ...]] = {
    "Where one action is the best": ONE_BEST,
    "Where actions count inside some balls alone": (
        "hopper, restricted",
        "halfcheetah, restricted",
    ),
}
"""Tasks on which the scores of `diverse` are compared with those of other arms."""


class Task(NamedTuple):
    """An environment, and what its runs have otherwise than the preset."""

    env: str
    options: tuple[str, ...]
    seeds: int
    changes: Mapping[str, Any]
    steps: int | None = None
    """By default half of those of the tables."""
    arms: tuple[str, ...] = tuple(ARMS)


SMALL: Mapping[str, Any] = {"environments": 32, "batch_size": 256, "updates_per_step": 0.25}
TASKS: Mapping[str, Task] = {
    "two_mode_bandit": Task("two_mode_bandit", (), 10, SMALL, 19_200),
    "four_bump_bandit": Task("four_bump_bandit", (), 10, SMALL, 19_200),
    "multi_goal": Task("multi_goal", (), 10, SMALL, 96_000),
    "multi_goal, three": Task("multi_goal", ("goals=three",), 10, SMALL, 96_000),
    "point_maze, v1": Task("point_maze", ("maze=v1",), 10, SMALL, 192_000),
    "point_maze, v2": Task("point_maze", ("maze=v2",), 10, SMALL, 192_000),
    "pendulum": Task("pendulum", (), 5, {}, 40_000, DETERMINISTIC),
    "halfcheetah": Task("halfcheetah", (), 5, {}, 300_000, DETERMINISTIC),
    "hopper": Task("hopper", (), 5, {}, 300_000, DETERMINISTIC),
    "walker2d": Task("walker2d", (), 5, {}, 300_000, DETERMINISTIC),
    "hopper, restricted": Task("hopper", ("restricted=1.25",), 5, {}),
    "halfcheetah, restricted": Task("halfcheetah", ("restricted=0.25",), 5, {}),
}


def runs(plan: Plan) -> list[Config]:
    """What is short first, of it what the picture shows; seed by seed, so that all grow."""
    wanted = []
    for place, (name, task) in enumerate(TASKS.items()):
        for number, label in enumerate(task.arms):
            short, shown = task.steps is not None, label in SHOWN
            wanted += [
                ((not short, short and not shown, config.seed, place, number), config)
                for config in arm(plan, name, label)
            ]
    return [config for _, config in sorted(wanted, key=lambda pair: pair[0])]


def arm(plan: Plan, name: str, label: str) -> list[Config]:
    """One arm on one task over all seeds; repulsion ends half way."""
    task, changes = TASKS[name], dict(ARMS[label])
    most = plan.base.steps // 2
    steps = most if task.steps is None else min(task.steps, most)
    shared = {"steps": steps, "evaluate_every": max(1, steps // 4), **task.changes}
    if "repulsion_updates" in changes:
        base: Any = plan.base
        ratio = task.changes.get("updates_per_step", base.updates_per_step)
        changes["repulsion_updates"] = round(steps * ratio / 2)
    return plan.over_seeds(task.env, task.seeds, env_options=task.options, **shared, **changes)


def section(plan: Plan) -> str:
    """A table of what each arm finds, and a picture of the four goals."""
    found = {
        name: {k: scores.of(plan, arm(plan, name, k)) for k in task.arms}
        for name, task in TASKS.items()
    }
    found = {name: {k: v for k, v in arms.items() if v} for name, arms in found.items()}
    found = {name: arms for name, arms in found.items() if arms}
    if not found:
        return rows.missing(runs(plan))
    lines = []
    for name, arms in found.items():
        for label, results in arms.items():
            score = [result.return_mean for result in results]
            lines.append([name, label, f"{statistics.mean(score):.2f}", *_ends(results)])
    header = ("task", "arm", "score", "ends reached", "entropy of behaviour", "seeds")
    text = (
        "Score: mean return of 100 episodes of the last policy, a head drawn uniformly and held as "
        "it was in training. Ends reached: how many of the goals or optima those episodes find; an "
        f"action finds an optimum of a bandit within {NEAR:g} of it, so that a policy that comes "
        "less near scores almost as much and finds none. "
        "Means with 95 % intervals over seeds.\n\n" + Table(header, lines).markdown()
    )
    for where, names in COMPARED.items():
        if compared := _compared(plan, names):
            text += (
                f"\n\n{where}: the probability that a run of `diverse` scores above one of "
                "another arm, 0.5 if it costs and brings nothing, and p of van Elteren's two-sided "
                "test, of each task and over the tasks together.\n\n"
                + Table(("over", *names, "together"), compared).markdown()
            )
    goals = found.get("multi_goal", {})
    shares = {
        label: {str(result.seed): _shares(result.metrics) for result in goals[label]}
        for label in SHOWN
        if label in goals
    }
    if shares:
        pictures.save(plan, draw_shares(shares, "seed", "share of the episodes", "goal"), "several")
        text += (
            "\n\n![Goals by arm and seed](several.png)\n\n"
            "Multi-goal, four goals that are equally good: the share of a policy's episodes that "
            "end at each, one bar a seed; none where its episodes reach no goal."
        )
    return text


def _compared(plan: Plan, names: Sequence[str]) -> list[list[str]]:
    """A line for each arm that `diverse` is compared with, once all of the tasks have both."""

    def of(label: str) -> list[np.ndarray]:
        return [scores.means(plan, arm(plan, name, label)) for name in names]

    lines = []
    for label in ("DDPG", "M = 10"):
        pairs = list(zip(of("diverse"), of(label), strict=True))
        if all(len(ours) and len(theirs) for ours, theirs in pairs):
            of_each = [[pair] for pair in pairs]
            cells = [
                f"{effect(of):.2f}, p = {van_elteren(of).either:.2g}" for of in (*of_each, pairs)
            ]
            lines.append([label, *cells])
    return lines


def _shares(metrics: Mapping[str, float]) -> list[float]:
    return [value for name, value in metrics.items() if name.endswith("_share")]


def _ends(results) -> list[str]:
    """Ends reached and entropy, where the task has ends; and the number of seeds."""
    cells = []
    for suffix in ("_reached", "_entropy"):
        values = [v for result in results for k, v in result.metrics.items() if k.endswith(suffix)]
        cells.append(f"{statistics.mean(values):.2f}" if values else "")
    return [*cells, f"n = {len(results)}"]
