"""How time and memory of a turn grow with its environments, heads, replay, observation and seeds.

A turn steps every environment once and makes one update, on a task that costs next to nothing.
"""

import dataclasses
import statistics
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any, NamedTuple, cast

import jax
import jax.numpy as jnp
import matplotlib.figure
import numpy as np

import envs
from benchmarks import commands
from envs.base import Action
from mapg_jax.reports import document, plots
from mapg_jax.training.config import Config, ReplayConfig, preset
from mapg_jax.training.lockstep import Lockstep
from mapg_jax.training.replay import Data, ReplayState

SECONDS = 0.5
"""Of a measurement, at least."""
ROUNDS = 3
BEND = 1.5
"""Times the least of an axis, from which on its cost is said to grow."""
PICTURE = commands.ROOT / "benchmarks/growth.png"


class Plain(envs.Env):
    """A walk in D dimensions, moved by its first."""

    action_high = np.ones(1, np.float32)

    def __init__(self, size: int = 8):
        self._size = size

    @property
    def observation_size(self) -> int:
        return self._size

    @property
    def action_size(self) -> int:
        return 1

    @property
    def backend(self) -> str:
        return "jax"

    def reset(self, rng: jax.Array) -> envs.State:
        observation, zero = jax.random.normal(rng, (self._size,)), jnp.zeros(())
        return envs.State(cast(Any, observation), observation, zero, zero, {}, {})

    def step(self, state: envs.State, action: Action) -> envs.State:
        observation = 0.99 * jnp.asarray(state.obs) + 0.1 * self.clipped(action)[0]
        return dataclasses.replace(
            state, pipeline_state=observation, obs=observation, reward=-(observation[0] ** 2)
        )


def register() -> None:
    """Names the walk, once a process."""
    if "growth" not in envs.names():
        envs.register("growth", Plain, time_limit=200)


class Cost(NamedTuple):
    """Of one turn."""

    steps: int
    """Of environments, all runs together."""
    seconds: float
    bytes: int
    """Of the state, and of what the compiled program needs beside it."""


def configure(environments: int = 16, size: int = 8, **changes) -> Config:
    """One update a turn; the replay is taken as full."""
    return preset(
        "paper",
        env="growth",
        env_options={"size": size},
        environments=environments,
        updates_per_step=1 / environments,
        learning_starts=64,
        **{"replay_size": 100_000, **changes},
    )


AXES: tuple[tuple[str, Sequence[int], Callable[[int], Sequence[Config]]], ...] = (
    ("environments", (1, 4, 16, 64, 256, 1_024, 4_096), lambda n: [configure(n)]),
    ("M", (1, 3, 10, 30, 100), lambda m: [configure(heads=m)]),
    ("slots of the replay", (10_000, 100_000, 1_000_000, 10_000_000),
     lambda slots: [configure(replay_size=slots)]),
    ("numbers observed", (4, 16, 64, 256, 1_024), lambda d: [configure(size=d)]),
    ("seeds in lockstep", (1, 2, 4, 8, 16),
     lambda n: [dataclasses.replace(configure(), seed=k) for k in range(n)]),
)  # fmt: skip
"""What is counted, its values, and the runs of one value."""


def report(quick: bool) -> str:
    """The section of the page."""
    register()
    lines = [
        "## How cost grows",
        "",
        f"A turn steps {configure().environments} environments that cost next to nothing and makes "
        "one update of MAPG (M = 10, batch 64, observations of 8, replay of 100,000); one of these "
        f"numbers changes at a time. Medians of {1 if quick else ROUNDS} rounds over all of them. "
        "The exponent is the slope of the logarithms over the last two values, and over all of "
        "them: near 0 a turn costs its instructions, whatever they work on; it bends from where on "
        f"all cost more than {BEND} times the least.",
        "",
        "| | | turns/s | steps/s | µs a turn | exponent, end | all | memory, MB | exponent, end "
        "| all |",
        f"{'|---' * 10}|",
    ]
    measured = _measured(quick)
    for title, costs in measured.items():
        lines += _rows(title, list(costs), list(costs.values()))
    lines.append("")
    for title, costs in measured.items():
        of_time = _bend(list(costs), [cost.seconds for cost in costs.values()])
        memory = _bend(list(costs), [cost.bytes for cost in costs.values()])
        lines.append(f"- {title}: time {of_time}; memory {memory}.")
    if not quick:
        PICTURE.write_bytes(document.picture_bytes(_draw(measured), "png"))
        lines += ["", f"![time and memory of a turn]({PICTURE.name})"]
    return "\n".join(lines)


def _measured(quick: bool) -> dict[str, dict[int, Cost]]:
    """By axis, of each of its values."""
    programs = {
        (title, count): Program(runs(count))
        for title, values, runs in AXES
        for count in (values[:2] if quick else values)
    }
    times = {name: [] for name in programs}
    for _ in range(1 if quick else ROUNDS):  # in turn: a machine that slows down slows all of them
        for name, program in programs.items():
            times[name].append(program.seconds(0.0 if quick else SECONDS))
    measured: dict[str, dict[int, Cost]] = {title: {} for title, _, _ in AXES}
    for (title, count), program in programs.items():
        seconds = statistics.median(times[title, count])
        measured[title][count] = Cost(program.steps, seconds, program.bytes)
    return measured


def _bend(counts: Sequence[int], costs: Sequence[float]) -> str:
    """From which value on a cost grows, and how."""
    relative = np.array(costs) / min(costs)
    least = counts[int(relative.argmin())]
    begun = f" ({relative[0]:.1f} times as much at {counts[0]:,})" if relative[0] >= 1.1 else ""
    low = np.flatnonzero(relative <= BEND)[-1]
    if low == len(counts) - 1:
        return (
            f"is least at {least:,}{begun}, and has no bend up to {counts[-1]:,}, where it is "
            f"{relative[-1]:.1f} times that"
        )
    slope = np.polyfit(np.log(counts[low:]), np.log(relative[low:]), 1)[0]
    return (
        f"is least at {least:,}{begun}, and bends after {counts[low]:,}, from where on its "
        f"exponent is {slope:.2f}"
    )


def _draw(measured: Mapping[str, Mapping[int, Cost]]) -> matplotlib.figure.Figure:
    """A column an axis: microseconds above, megabytes below."""
    figure = matplotlib.figure.Figure(figsize=(12, 5), layout="constrained")
    panels = figure.subplots(2, len(measured), sharey="row")
    for column, (title, costs) in zip(panels.T, measured.items(), strict=True):
        numbers = [1e6 * cost.seconds for cost in costs.values()]
        megabytes = [cost.bytes / 1e6 for cost in costs.values()]
        for axes, values in zip(column, (numbers, megabytes), strict=True):
            axes.loglog(list(costs), values, "o-", color=plots.COLOURS[1])
            axes.grid(alpha=0.3)
        column[1].set_xlabel(title)
    panels[0, 0].set_ylabel("µs a turn")
    panels[1, 0].set_ylabel("memory, MB")
    return figure


def _rows(title: str, counts: Sequence[int], costs: Sequence[Cost]) -> Iterator[str]:
    slopes = [_slopes(counts, [cost.seconds for cost in costs])]
    slopes.append(_slopes(counts, [cost.bytes for cost in costs]))
    for i, (count, cost) in enumerate(zip(counts, costs, strict=True)):
        seconds, memory = slopes if i == len(counts) - 1 else (" | ", " | ")
        yield (
            f"| {title if i == 0 else ''} | {count:,} | {1 / cost.seconds:,.0f} | "
            f"{cost.steps / cost.seconds:,.0f} | {1e6 * cost.seconds:,.0f} | {seconds} | "
            f"{cost.bytes / 1e6:,.1f} | {memory} |"
        )


def _slopes(counts: Sequence[int], costs: Sequence[float]) -> str:
    """Two cells: of the logarithms over the last two values, and over all."""
    x, y = np.log(counts), np.log(costs)
    return f"{np.diff(y)[-1] / np.diff(x)[-1]:.2f} | {np.polyfit(x, y, 1)[0]:.2f}"


class Program:
    """Runs that learn, and what a turn of them takes."""

    def __init__(self, configs: Sequence[Config]):
        program = Lockstep(configs)
        state = program.init()
        slots = cast(ReplayConfig, configs[0]).replay_size
        state = state.replace(replay=_full(state.replay, slots))
        self._run = program.jitted_run.lower(state, 0).compile()
        self._state, self._turns = self._run(state, 64), 64  # fills what learning waits for
        self.bytes = _bytes(self._run)
        self.steps = sum(config.environments for config in configs)

    def seconds(self, at_least: float) -> float:
        """Of a turn, measured over so many seconds."""
        while True:
            begun = time.perf_counter()
            self._state = jax.block_until_ready(self._run(self._state, self._turns))
            seconds = time.perf_counter() - begun
            if seconds >= at_least:
                return seconds / self._turns
            self._turns = int(self._turns * min(16.0, 1.2 * at_least / max(seconds, 1e-4))) + 1


def _full(empty: ReplayState, slots: int) -> ReplayState:
    """As if it were: every step with observations of its own."""
    steps, observations = empty.data
    row = jnp.broadcast_to(jnp.arange(slots, dtype=jnp.int32), steps.observation.shape)
    steps = steps._replace(observation=row, next_observation=row + 1)
    return empty.replace(
        data=Data(steps, observations),
        size=jnp.full_like(empty.size, slots),
        row=jnp.full_like(empty.row, slots),
        rows=jnp.full_like(empty.rows, observations.shape[-2]),
    )


def _bytes(run: Any) -> int:
    """Of its arguments, and of what it needs beside them, as its compiler says."""
    analysis = run.memory_analysis()
    return analysis.argument_size_in_bytes + analysis.temp_size_in_bytes
