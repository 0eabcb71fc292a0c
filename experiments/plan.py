"""Which runs the experiments need, under which names, and in which order."""

import dataclasses
import functools
import pathlib
from collections.abc import Iterable, Mapping
from typing import Any, Literal, NamedTuple

from mapg_jax.algorithms import registry
from mapg_jax.training.config import Config, Preset, ReplayConfig, fields, preset

TASKS = ("hopper", "walker2d", "humanoid", "halfcheetah", "swimmer")
HEADS = (5, 10, 20, 50)
DDPG: Mapping[str, Any] = {"heads": 1}
MAPG: Mapping[str, Any] = {"heads": 10}
A3C: Mapping[str, Any] = {"algorithm": "a3c"}
NO_NOISE: Mapping[str, Any] = {"noise": "none"}
DRIVING: Mapping[str, Any] = {
    # Chosen with DDPG alone: docs/driving.md.
    "env_options": ("control_hz=10", "start=anywhere"),
    "time_limit": 2_000,
}
SHARED = ("steps", "evaluate_every", "checkpoints_kept")
"""What all runs of a plan have of its base, whatever their algorithm is."""
EVALUATIONS = {"paper": 40, "smoke": 10}
"""In training; whole episodes of 1,000 steps, so that many of them would be most of a smoke run."""
TIMING = {"paper": (9, 1.0), "smoke": (3, 0.1)}
"""Of the heads' cost: rounds, and seconds of each M in a round."""
RULES: Mapping[str, Mapping[str, Any]] = {
    "all": {"gradient": "all"},
    "wide": {"head_spread": 1.0},
    "diverse": registry.find("mapg").presets.get("diverse", {}),
}
"""Of the heads, beside the paper's; those that the algorithm does not have are left out."""
FIRST_SEED = 2_000
"""Of the protocol's version 2."""
EARLIER_SEEDS = 10
"""Version 1 had fewer: 0, 1, …"""
SEEDS = {"core": 8, "others": 5}
SEEDS_OF_HUMANOID = {"core": 6, "others": 2}
"""Of a cell; a run of Humanoid takes four times as long."""
NOWHERE = pathlib.Path()
"""Of a plan whose folders do not matter."""


class Plan(NamedTuple):
    """What all runs of an invocation share, how many there are, and where they go."""

    base: ReplayConfig
    """MAPG by the preset, with the steps and the cadence of evaluation that all runs share."""
    seeds: int | None
    """Of a cell, at most; by default as many as the protocol has."""
    runs: pathlib.Path
    """Run folders; not committed."""
    results: pathlib.Path
    """What the runs wrote, as CSV, and what is made of it."""
    tasks: tuple[str, ...] = TASKS
    """Of Table 2."""
    heads: tuple[int, ...] = HEADS
    """M, beside DDPG's 1."""
    studied: tuple[str, ...] = ("pendulum", "halfcheetah")
    """Tasks on which DDPG and M = 10 are compared with and without noise."""
    ruled: tuple[str, ...] = ("halfcheetah", "hopper", "pendulum")
    """Tasks on which the rules of the heads are compared."""
    carried: tuple[str, ...] = ("pendulum", "hopper", "halfcheetah", "walker2d")
    """Tasks on which other algorithms are compared with themselves."""
    timing: tuple[int, float] = TIMING["paper"]
    preset: Preset = "paper"
    flags: str = ""
    """Of the command."""
    version: Literal[1, 2] = 2
    """Of the protocol: version 1 is read, for what its seeds gave; runs are of version 2."""

    @property
    def recorded(self) -> pathlib.Path:
        """CSV files of the runs of its version; those of version 1 are closed."""
        return self.results if self.version == 2 else self.results / "version_1"

    @property
    def measured(self) -> pathlib.Path:
        """CSV files of what was measured on the runs beside their scores."""
        return self.recorded / "measured"

    def config(self, env: str, seed: int = FIRST_SEED, **changes) -> Config:
        """One run."""
        shared = {name: getattr(self.base, name) for name in SHARED}
        return preset(self.preset, **{**shared, "env": env, "seed": seed, **changes})

    def arms(self) -> dict[str, Mapping[str, Any]]:
        """The columns of Table 2, by their names."""
        return {"DDPG": DDPG, "A3C": A3C, **{f"M = {m}": {"heads": m} for m in self.heads}}

    def rules(self) -> dict[str, Mapping[str, Any]]:
        """RULES that the algorithm has, by their names."""
        known = fields(type(self.base))
        return {name: rule for name, rule in RULES.items() if rule and set(rule) <= set(known)}

    def over_seeds(self, env: str, count: int | None = None, /, **changes) -> list[Config]:
        """One cell: its runs over all seeds of the protocol, or the first ones of them.

        Args:
          env: its task.
          count: of its seeds; by default what items 1 to 5 of the protocol say.
          **changes: what sets the cell apart.
        """
        anywhere = self._replace(runs=NOWHERE, results=NOWHERE)
        return list(_cell(anywhere, env, count, tuple(changes.items())))

    def folder(self, config: Config) -> pathlib.Path:
        """Where a run is trained."""
        return self.runs / name(config, self)


@functools.cache
def _cell(
    plan: Plan, env: str, count: int | None, changes: tuple[tuple[str, Any], ...]
) -> tuple[Config, ...]:
    """Made once: a page asks for the same cells many times, wherever it is written."""
    first = plan.config(env, FIRST_SEED if plan.version == 2 else 0, **dict(changes))
    most = (count or seeds(first, plan)) if plan.version == 2 else EARLIER_SEEDS
    wanted = most if plan.seeds is None else min(plan.seeds, most)
    return tuple(dataclasses.replace(first, seed=first.seed + k) for k in range(wanted))


def make_plan(
    name: Preset, steps: int | None, seeds: int | None, runs: pathlib.Path, results: pathlib.Path
) -> Plan:
    """The plan of a preset, its steps unless others are given.

    Raises:
      ValueError: if the steps cannot be met exactly by every algorithm.
    """
    base: Any = preset(name)
    flags = "" if name == "paper" else f" --preset {name}"
    if steps not in (None, base.steps):
        base, flags = dataclasses.replace(base, steps=steps), f"{flags} --steps {steps}"
    if seeds is not None:
        flags = f" --seeds {seeds}{flags}"
    a3c: Any = preset(name, "a3c")
    turn = a3c.environments * a3c.rollout_steps
    if base.steps % turn:
        nearest = max(1, round(base.steps / turn)) * turn
        raise ValueError(
            f"steps must be a multiple of {turn}, {base.environments} environments times "
            f"A3C's rollouts of {a3c.rollout_steps}; got {base.steps}, and {nearest} is near"
        )
    every = max(1, base.steps // EVALUATIONS[name])
    base = dataclasses.replace(base, evaluate_every=every, checkpoints_kept=1)
    return Plan(base, seeds, runs, results, timing=TIMING[name], preset=name, flags=flags)


def is_the_papers(plan: Plan) -> bool:
    """Whether its results are those of the project itself, which its README shows."""
    return plan.results == pathlib.Path("results") and not plan.flags


def name(config: Config, plan: Plan) -> str:
    """The folder of a run, by what sets it apart: `hopper-ddpg-m1-s2000`."""
    if not _differences(config, _reference(config.algorithm)):
        steps = config.steps
        return f"{config.env}-{config.slug}-reference-m{config.heads}-{steps}-s{config.seed}"
    parts = [config.env, config.slug, f"m{config.heads}"]
    if config.steps != plan.base.steps:
        parts.append(str(config.steps))
    if config.env_options != DRIVING["env_options"]:  # which all of driving's have
        parts += config.env_options
    for field in sorted(changed(config, plan) - {"env_options", "time_limit"}):
        value = getattr(config, field)
        parts.append(value if isinstance(value, str) else f"{field}{value}")
    return "-".join([*parts, f"s{config.seed}"])


def seeds(config: Config, plan: Plan) -> int:
    """How many the protocol has of a cell, which it fixed before the first of them."""
    counts = SEEDS_OF_HUMANOID if config.env == "humanoid" else SEEDS
    return counts["core" if is_core(config, plan) else "others"]


def in_order(plan: Plan, wanted: Iterable[Config]) -> list[Config]:
    """The runs of items 1 to 5 in the protocol's order, which does not depend on what comes out."""

    def rank(config: Config):
        slow = config.env == "humanoid"
        place = config.seed, config.env, config.heads, name(config, plan)
        return item(config, plan), slow, *place

    return sorted(dict.fromkeys(wanted), key=rank)


def item(config: Config, plan: Plan) -> int:
    """Of the protocol's list of runs."""
    core = is_core(config, plan)
    if config.env not in TASKS or "noise" in changed(config, plan):
        return 3
    if config.algorithm == plan.base.algorithm and not core and config.heads == MAPG["heads"]:
        return 5
    if core:
        return 1
    return 4 if config.env == "humanoid" else 2


def is_core(config: Config, plan: Plan) -> bool:
    """DDPG and M = 10 by the paper's rules: of Table 2, driving and Figure 4."""
    free = {"env_options", "time_limit", "noise"}
    known = config.algorithm == plan.base.algorithm and config.heads in (
        DDPG["heads"],
        MAPG["heads"],
    )
    return known and changed(config, plan) <= free


def changed(config: Config, plan: Plan) -> set[str]:
    """What a run has otherwise than its algorithm's preset, beside its seed, M and steps."""
    return _differences(config, _usual(plan, config.algorithm))


def _differences(config: Config, usual: Config) -> set[str]:
    bears = {name for name, field in fields(type(usual)).items() if not field.metadata["host"]}
    names = bears - {"env", "seed", "heads", "steps"}
    return {name for name in names if getattr(config, name) != getattr(usual, name)}


@functools.cache
def _reference(algorithm: str) -> Config:
    return preset("reference", algorithm)


@functools.cache
def _usual(plan: Plan, algorithm: str) -> Config:
    return plan.config("pendulum", algorithm=algorithm)
