"""python -m benchmarks.parallel: what `parallel` learns in ten minutes of a core, beside `paper`.

A run is one `mapg train` with one thread, stopped after ten minutes; as many go side by side as
there are cores. Its evaluations go to benchmarks/parallel.csv, and what stands there is not run
again, so that the command goes on where it was stopped. docs/parallel.md is made of that file.
"""

import argparse
import collections
import concurrent.futures
import math
import os
import pathlib
import shlex
import signal
import subprocess
import sys
import tempfile
import threading
from collections.abc import Iterator, Mapping, Sequence
from typing import NamedTuple

import matplotlib.figure
import numpy as np

from benchmarks import commands
from mapg_jax.algorithms import registry
from mapg_jax.reports import document, plots
from mapg_jax.runs import csv_file
from mapg_jax.runs.metrics import read_metrics

FILE = commands.ROOT / "benchmarks/parallel.csv"
PAGE = commands.ROOT / "docs/parallel.md"
PICTURE = commands.ROOT / "docs/parallel.png"
SEEDS = (0, 1, 2)
PRESETS = ("paper", "parallel")
HEADER = (
    "task", "algorithm", "preset", "seed", "seconds", "env_steps", "return_mean", "lap_share"
)  # fmt: skip
MINUTES = (2, 5, 10)
"""After which runs are compared; the last is when they are stopped."""
POINT_SECONDS = 20
"""A point of the picture is the mean of the evaluations in so much time."""
DRIVING = "--env-options control_hz=10 start=anywhere --time-limit 2000"


class Task(NamedTuple):
    """What is learned, and by how many environments where they are many."""

    flags: str
    environments: int
    algorithms: tuple[str, ...]
    evaluate_every: Mapping[str, int]
    """Environment steps, by preset: every half a minute or so."""


TASKS = {
    "driving": Task(DRIVING, 1024, ("mapg", "ppo"), {"paper": 50_000, "parallel": 500_000}),
    "pendulum": Task("", 4096, ("mapg", "ppo"), {"paper": 20_000, "parallel": 200_000}),
    "halfcheetah": Task(
        "", 256, ("mapg", "ppo", "td3", "sac"), {"paper": 50_000, "parallel": 150_000}
    ),
    "hopper": Task("", 256, ("mapg", "ppo"), {"paper": 50_000, "parallel": 150_000}),
}


class Run(NamedTuple):
    """One training."""

    task: str
    algorithm: str
    preset: str
    seed: int

    def flags(self) -> list[str]:
        """Of `mapg train`."""
        task = TASKS[self.task]
        flags = f"--env {self.task} {task.flags} --algorithm {self.algorithm} --seed {self.seed} "
        flags += f"--preset {self.preset} --evaluate-every {task.evaluate_every[self.preset]} "
        if self.preset == "parallel":
            flags += of_parallel(self.algorithm, task.environments)
        if learns_from_replay(self.algorithm):
            flags += " --no-save-replay"
        return shlex.split(f"{flags} --steps 2000000000")


def learns_from_replay(algorithm: str) -> bool:
    return registry.find(algorithm).experience == "replay"


def of_parallel(algorithm: str, environments: int) -> str:
    """The preset at another number of environments, in its proportions, with the paper's networks.

    Learning from replay: two samples of the batch an environment, eight updates a turn.
    """
    flags = f"--hidden 64 64 --environments {environments}"
    if not learns_from_replay(algorithm):
        return flags
    return (
        f"{flags} --batch-size {2 * environments} --updates-per-step {8 / environments} "
        f"--learning-starts {32 * environments}"
    )


def runs() -> Iterator[Run]:
    """In order: every cell gets a seed before any gets its next."""
    for seed in SEEDS:
        for name, task in TASKS.items():
            for algorithm in task.algorithms:
                for preset in reversed(PRESETS):
                    yield Run(name, algorithm, preset, seed)


def measure(run: Run, stopping: threading.Event) -> list[dict[str, float]]:
    """The evaluations of a training until its time is up, the time to compile included."""
    with tempfile.TemporaryDirectory() as parent:
        out, said = pathlib.Path(parent) / "run", pathlib.Path(parent) / "said"
        command = [sys.executable, "-P", "-m", "mapg_jax", "train", *run.flags(), "--out", out]
        environment = {**os.environ, "PYTHONPATH": str(commands.ROOT), "NPROC": "1"}
        with (
            said.open("w") as file,  # a pipe that nobody reads is full after 700 evaluations
            subprocess.Popen(
                command, env=environment, stdout=subprocess.DEVNULL, stderr=file
            ) as process,
        ):
            for _ in range(60 * MINUTES[-1]):
                if stopping.wait(1.0) or process.poll() is not None:
                    break
            ended = process.poll() is not None
            process.send_signal(signal.SIGTERM)
        if ended:
            raise RuntimeError(
                f"{shlex.join(run.flags())} ended by itself: {said.read_text()[-500:]}"
            )
        return [] if stopping.is_set() else read_metrics(out / "metrics.csv")


def train(workers: int) -> None:
    """What is missing; a row of the file is an evaluation."""
    done = set(evaluations(FILE))
    lock, stopping = threading.Lock(), threading.Event()

    def one(run: Run) -> None:
        rows = [] if stopping.is_set() else measure(run, stopping)
        if not rows:
            return
        with lock:
            header, old = csv_file.read(FILE)
            new = [[*run, *(row.get(name, "") for name in HEADER[len(run) :])] for row in rows]
            csv_file.write(FILE, header or HEADER, [*old, *new])
            print(shlex.join(map(str, run)), f"{len(rows)} evaluations", flush=True)

    with concurrent.futures.ThreadPoolExecutor(workers) as pool:
        try:
            left = [pool.submit(one, run) for run in runs() if run not in done]
            for future in concurrent.futures.as_completed(left):
                future.result()
        finally:
            stopping.set()


Curve = Mapping[str, np.ndarray]


def evaluations(file: pathlib.Path) -> dict[Run, Curve]:
    """Of every run of the file, its columns."""
    found: dict[Run, list[list[float]]] = {}
    for task, algorithm, preset, seed, *numbers in csv_file.read(file)[1]:
        run = Run(task, algorithm, preset, int(seed))
        found.setdefault(run, []).append([float(x or "nan") for x in numbers])
    return {
        run: dict(zip(HEADER[4:], np.array(rows).T, strict=True)) for run, rows in found.items()
    }


def after(curve: Curve, minutes: float, column: str = "return_mean") -> float:
    """Of the last evaluation until then; nan before the first."""
    until = curve["seconds"] <= 60 * minutes
    return float(curve[column][until][-1]) if until.any() else float("nan")


def returns(found: Mapping[Run, Curve]) -> document.Table:
    """What has been learned after some minutes, by task and algorithm, as far as it was run."""
    rows = [
        (task, algorithm, str(minutes), *_compared(*seeds))
        for task, of_task in TASKS.items()
        for algorithm in of_task.algorithms
        for minutes in MINUTES
        for seeds in [[_after(found, (task, algorithm, x), minutes) for x in PRESETS]]
        if any(seeds)
    ]
    header = ("task", "algorithm", "minutes", *PRESETS, "parallel − paper", "wins", "seeds")
    return document.Table(header, rows)


def best(found: Mapping[Run, Curve]) -> document.Table:
    """The algorithm and preset whose mean over seeds is the highest after some minutes."""
    rows = []
    for task, of_task in TASKS.items():
        row = [task]
        for minutes in MINUTES:
            means = {
                f"{algorithm}, {preset}": np.mean(values)
                for algorithm in of_task.algorithms
                for preset in PRESETS
                if (values := _after(found, (task, algorithm, preset), minutes))
                and np.isfinite(values).all()
            }
            leader = max(means, key=means.__getitem__, default="")
            row.append(f"{leader}: {means[leader]:,.0f}" if leader else "")
        rows.append(tuple(row))
    return document.Table(("task", *(f"{minutes} min" for minutes in MINUTES)), rows)


def _after(found: Mapping[Run, Curve], cell: tuple, minutes: float) -> list[float]:
    """Of the seeds of a cell."""
    return [after(curve, minutes) for run, curve in found.items() if run[:3] == cell]


def _compared(paper: Sequence[float], parallel: Sequence[float]) -> tuple[str, ...]:
    """Both presets, what `parallel` gains, which wins, and how many seeds there are of each."""
    gain = np.mean(parallel) - np.mean(paper) if paper and parallel else np.nan
    both = (f"{gain:+,.0f}", _wins(paper, parallel)) if np.isfinite(gain) else ("", "")
    return _range(paper), _range(parallel), *both, f"{len(paper)}, {len(parallel)}"


def _wins(paper: Sequence[float], parallel: Sequence[float]) -> str:
    """The preset whose least seed is above the other's largest."""
    if min(parallel) > max(paper):
        return "parallel"
    return "paper" if min(paper) > max(parallel) else "neither"


def _range(values: Sequence[float]) -> str:
    """Their mean, and between which they lie."""
    if not np.isfinite(values).all() or not values:
        return "not evaluated yet" if values else ""
    mean = f"{np.mean(values):,.0f}"
    return f"{mean} ({min(values):,.0f} to {max(values):,.0f})" if len(values) > 1 else mean


def laps(found: Mapping[Run, Curve]) -> document.Table:
    """The share of an evaluation's episodes that drive a whole lap, seed by seed."""
    rows = [
        (run.algorithm, run.preset, str(run.seed), *(f"{share:.0%}" for share in shares))
        for run, curve in found.items()
        if run.task == "driving"
        for shares in [[after(curve, minutes, "lap_share") for minutes in MINUTES]]
    ]
    header = (
        "algorithm",
        "preset",
        "seed",
        *(f"{minutes} min" for minutes in MINUTES),
    )
    return document.Table(header, sorted(rows))


def points(curve: Curve) -> tuple[list[float], list[float]]:
    """Minutes and returns, means over `POINT_SECONDS` each: evaluations may be a second apart."""
    bins = curve["seconds"] // POINT_SECONDS
    inside = [bins == k for k in np.unique(bins)]
    return (
        [float(curve["seconds"][x].mean()) / 60 for x in inside],
        [float(curve["return_mean"][x].mean()) for x in inside],
    )


def draw(found: Mapping[Run, Curve]) -> matplotlib.figure.Figure:
    """A panel a task: return over minutes, a line a seed, a colour an algorithm and preset."""
    figure = matplotlib.figure.Figure(figsize=(10, 7), layout="constrained")
    arms = [(a, p) for a in TASKS["halfcheetah"].algorithms for p in PRESETS]
    styles = {
        arm: {"color": plots.COLOURS[k // 2], "linestyle": ("--", "-")[k % 2]}
        for k, arm in enumerate(arms)
    }
    tasks = [task for task in TASKS if any(run.task == task for run in found)]
    panels = list(
        figure.subplots(math.ceil(len(tasks) / 2), min(2, len(tasks)), squeeze=False).flat
    )
    for axes, task in zip(panels, tasks, strict=False):
        axes.set(title=task, xlabel="minutes", ylabel="return of an evaluation")
        for run, curve in found.items():
            if run.task == task:
                style = styles[run.algorithm, run.preset]
                axes.plot(*points(curve), linewidth=1.2, **style)
    shown = {(run.algorithm, run.preset) for run in found}
    for arm, style in styles.items():
        if arm not in shown:
            continue
        of_tasks = collections.Counter(x.task for x in found if (x.algorithm, x.preset) == arm)
        seeds = sorted(set(of_tasks.values()))
        n = f"{seeds[0]} to {seeds[-1]}" if len(seeds) > 1 else seeds[0]
        panels[0].plot([], [], label=f"{', '.join(arm)} (n = {n})", **style)
    for axes in panels[len(tasks) :]:
        axes.axis("off")
    figure.legend(loc="outside lower center", ncols=4, frameon=False)
    return figure


def page(found: Mapping[Run, Curve]) -> str:
    """docs/parallel.md."""
    blocks = [
        document.Heading("Many environments on one core: `parallel` beside `paper`", 1),
        document.Paragraph(
            "Wall-clock learning curves of whole commands, the time to compile and to evaluate "
            "included, with one thread each, as many side by side as the machine has cores: two. "
            "`paper` is the preset of that name: 16 "
            "environments, batches of 64. `parallel` is the preset for thousands of environments, "
            "here with the paper's networks of 64-64, and batch and updates in proportion to the "
            "environments: 16 samples an environment step. M = 10 everywhere. A solid line is "
            "`parallel`, a dashed one `paper`; each is a seed, and a point of it the mean of its "
            f"evaluations in {POINT_SECONDS} s."
        ),
        document.Picture(draw(found), PICTURE.stem, "return over minutes"),
        document.Paragraph(
            "The return of the last evaluation so far (10 episodes, of `parallel` 128): the mean "
            "over seeds, and between which they lie. A preset wins where all its seeds are above "
            "all of the other's; of three against three alike, one of them does by chance in one "
            "comparison of ten, and of one against one always. Most presets of a seed went "
            "side by side; the others on a machine that may have been faster or slower by then."
        ),
        returns(found),
        document.Paragraph("The highest mean over seeds, of all algorithms and both presets:"),
        best(found),
        document.Paragraph(
            "What was tried where `mapg` by `parallel` loses what it has learned: "
            "[notes](../benchmarks/notes.md#preset-parallel-rates-that-saturate)."
        ),
        document.Heading("Driving: episodes with a whole lap", 2),
        document.Paragraph("Of the last evaluation so far, by seed."),
        laps(found),
        document.Heading("The commands", 2),
        document.Paragraph(
            "`python -m benchmarks.parallel` goes on with what is missing, writes "
            "benchmarks/parallel.csv and makes this page of it. What it runs, with seed 0:"
        ),
        document.Bullets([f"`mapg train {shlex.join(x.flags())}`" for x in runs() if x.seed == 0]),
    ]
    return document.markdown(blocks)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--no-train", action="store_true", help="only make the page")
    parser.add_argument("--workers", type=int, default=os.cpu_count(), help="runs side by side")
    arguments = parser.parse_args()
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(128 + signal.SIGTERM))  # ends its runs too
    if not arguments.no_train:
        train(arguments.workers)
    found = evaluations(FILE)
    PICTURE.write_bytes(document.picture_bytes(draw(found), "png"))
    PAGE.write_text(page(found))


if __name__ == "__main__":
    main()
