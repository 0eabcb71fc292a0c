"""Which runs the experiments need, under which names, and in which order."""

import dataclasses
import pathlib
from collections.abc import Iterable, Mapping
from typing import Any, NamedTuple

from mapg_jax.training.config import Config, Preset, preset

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
    "stored": {},
    "resampled": {"gradient": "resampled"},
    "all": {"gradient": "all"},
    "sampled target": {"target": "sampled"},
}
"""Of the actor's gradient, and of the target; `stored` with the mean is the default."""


class Plan(NamedTuple):
    """What all runs of an invocation share, how many there are, and where they go."""

    base: Config
    """MAPG by the preset, with the steps and the cadence of evaluation that all runs share."""
    seeds: int
    runs: pathlib.Path
    """Run folders; not committed."""
    results: pathlib.Path
    """What the runs wrote, as CSV, and what is made of it."""
    tasks: tuple[str, ...] = TASKS
    """Of Table 2."""
    heads: tuple[int, ...] = HEADS
    """M, beside DDPG's 1."""
    studied: tuple[str, ...] = ("pendulum", "halfcheetah")
    """Tasks on which noise and the rules of the heads are compared."""
    timing: tuple[int, float] = TIMING["paper"]
    preset: Preset = "paper"
    flags: str = ""
    """Of the command, beside the seeds."""

    @property
    def measured(self) -> pathlib.Path:
        """CSV files of what was measured on the runs beside their scores."""
        return self.results / "measured"

    def config(self, env: str, seed: int = 0, **changes) -> Config:
        """One run."""
        shared = {name: getattr(self.base, name) for name in SHARED}
        return preset(self.preset, **{**shared, "env": env, "seed": seed, **changes})

    def arms(self) -> dict[str, Mapping[str, Any]]:
        """The columns of Table 2, by their names."""
        return {"DDPG": DDPG, "A3C": A3C, **{f"M = {m}": {"heads": m} for m in self.heads}}

    def over_seeds(self, env: str, **changes) -> list[Config]:
        """One cell: its runs over all seeds."""
        return [self.config(env, seed, **changes) for seed in range(self.seeds)]

    def folder(self, config: Config) -> pathlib.Path:
        """Where a run is trained."""
        return self.runs / name(config, self.base)


def make_plan(
    name: Preset, steps: int | None, seeds: int, runs: pathlib.Path, results: pathlib.Path
) -> Plan:
    """The plan of a preset, its steps unless others are given.

    Raises:
      ValueError: if the steps cannot be met exactly by every algorithm.
    """
    base: Any = preset(name)
    flags = "" if name == "paper" else f" --preset {name}"
    if steps not in (None, base.steps):
        base, flags = dataclasses.replace(base, steps=steps), f"{flags} --steps {steps}"
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


def name(config: Config, base: Config) -> str:
    """The folder of a run, by what sets it apart: `hopper-ddpg-m1-s0`."""
    parts = [config.env, config.slug, f"m{config.heads}"]
    for field in ("steps", "noise", "gradient", "target"):
        if getattr(config, field, None) not in (None, getattr(base, field)):
            parts.append(str(getattr(config, field)))
    return "-".join([*parts, f"s{config.seed}"])


def in_order(plan: Plan, wanted: Iterable[Config]) -> list[Config]:
    """The runs in the protocol's order, each once; it does not depend on what comes out."""

    def rank(config: Config):
        first = config.seed == 0
        core = _is_core(config, plan.base) and (_has(config, plan.base, "noise") or not first)
        # Seed 0 of the core, the rest of seed 0, the core seed by seed, the rest seed by seed.
        stage = (0 if core else 1) if first else (2 if core else 3)
        slow = config.env == "humanoid"  # four times as long: two turns after the others
        turn = config.seed + 2 * slow
        return stage, turn, slow, config.env, config.heads, name(config, plan.base)

    return sorted(dict.fromkeys(wanted), key=rank)


def _is_core(config: Config, base: Config) -> bool:
    """DDPG and M = 10, of Table 2, driving and Figure 4."""
    return config.heads in (1, 10) and _has(config, base, "gradient", "target")


def _has(config: Config, base: Config, *names: str) -> bool:
    """Whether a run of MAPG has those options of the base."""
    return config.algorithm == base.algorithm and all(
        getattr(config, name) == getattr(base, name) for name in names
    )
