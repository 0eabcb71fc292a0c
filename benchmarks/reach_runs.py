"""Runs until they reach a given return: ours, and the peers' by their best settings.

A run is one process with one thread, watched from outside: it is ended by its first evaluation that
reaches the return, or when its time is up. What it took goes to benchmarks/reach.csv, and what
stands there is not run again.
"""

import concurrent.futures
import contextlib
import math
import os
import pathlib
import shlex
import signal
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Iterator, Mapping, Sequence
from typing import NamedTuple

from benchmarks import commands
from benchmarks.learning import PEERS
from benchmarks.peers import known
from mapg_jax.algorithms import registry
from mapg_jax.runs import csv_file
from mapg_jax.runs.metrics import read_metrics

FILE = commands.ROOT / "benchmarks/reach.csv"
SEEDS = (0, 1, 2)
POLL = 0.1
"""Seconds between looks at a run: so late a time can be."""
HEADER = ("task", "learner", "seed", "seconds", "env_steps", "return_mean", "limit_seconds")
HEADS = 10
"""M of one, at least, of ours that go on beyond the first seed: what the project is for."""


class Task(NamedTuple):
    """What is to be reached."""

    target: float
    """Mean return of an evaluation's ten episodes, at least."""
    limit: float
    """Seconds after which a run is ended."""


TASKS = {
    "pendulum": Task(-200, 120),
    "halfcheetah": Task(2_000, 480),
    "hopper": Task(800, 480),
}


class Learner(NamedTuple):
    """One way to learn a task."""

    name: str
    command: tuple[str, ...]
    """That learns until it is ended, given `--seed SEED --out FOLDER` too."""
    settings: str
    """And where they are from."""
    heads: int = 0
    """M of ours; 0 of a peer."""


class Result(NamedTuple):
    """Of one run."""

    task: str
    learner: str
    seed: int
    seconds: float
    """From the start of the process to the end of the evaluation; infinite if none reached."""
    env_steps: float
    return_mean: float
    """Of that evaluation, or of the last; nan if there was none."""
    limit: float

    @property
    def reached(self) -> bool:
        return math.isfinite(self.seconds)


def ours(
    task: str, algorithm: str, heads: int, flags: str, evaluate_every: int, variant: str = ""
) -> Learner:
    """By the command line, as its users run it; the variant goes into the name."""
    settings = f"--algorithm {algorithm} --heads {heads} {flags}"
    rest = f"--evaluate-every {evaluate_every} --evaluation-episodes 10 --steps 2000000000"
    rest += " --no-save-replay" if registry.find(algorithm).experience == "replay" else ""
    label = registry.find(algorithm).label(heads)
    return Learner(
        f"mapg-jax, {label}{variant and f', {variant}'}",
        (sys.executable, "-m", "mapg_jax", "train", "--env", task, *f"{settings} {rest}".split()),
        f"`{settings}`",
        heads,
    )


def peer(task: str, peer: known.Known) -> Learner:
    """In .venv-peers, with the settings that are published for it."""
    return Learner(
        f"{known.LIBRARIES[peer.library]}, {peer.algorithm}",
        (str(PEERS), "-m", "benchmarks.peers.reach", peer.library, peer.algorithm, task),
        peer.source,
    )


PAPER = "--preset paper"
REFERENCE = "--preset reference"
MANY = "--preset parallel --hidden 64 64 --environments {}"
SHORT = f"{REFERENCE} --annealing-updates 0 --rollout-steps 64 --minibatches 16"
"""PPO that updates often: rollouts of a thousand steps at most, all environments together."""
MUJOCO = (
    ("mapg", 1, PAPER, 20_000),
    ("mapg", 10, PAPER, 20_000),
    ("ppo", 1, MANY.format(256), 65_536),
    ("ppo", 10, MANY.format(256), 65_536),
    ("td3", 1, REFERENCE, 2_000),
    ("sac", 1, REFERENCE, 2_000),
)
"""Algorithm, M, preset, and environment steps between evaluations: every 5 to 10 s of training."""


def short(flags: str, evaluate_every: int) -> tuple[tuple[str, int, str, int, str], ...]:
    """PPO of short rollouts, with one head and ten, evaluated as often as the peers' PPO."""
    flags = f"{SHORT} {flags}"
    return tuple(("ppo", m, flags, evaluate_every, "short rollouts") for m in (1, HEADS))


OURS = {
    "pendulum": (
        ("mapg", 1, PAPER, 5_000),
        ("mapg", 10, PAPER, 5_000),
        ("ppo", 1, MANY.format(1024), 65_536),
        ("ppo", 10, MANY.format(1024), 65_536),
        *short(
            "--environments 16 --discount 0.9 --actor-learning-rate 1e-3 "
            "--critic-learning-rate 1e-3",
            4_096,
        ),
    ),
    "halfcheetah": (
        *MUJOCO,
        *short("--environments 8 --epochs 5 --discount 0.98 --trace 0.92", 10_240),
    ),
    "hopper": (
        *MUJOCO,
        *short("--environments 8 --epochs 5 --discount 0.999 --trace 0.99", 10_240),
    ),
}
"""Discounts and traces of short rollouts, and on Pendulum the rates, are those of `known`."""
LEARNERS: Mapping[str, tuple[Learner, ...]] = {
    task: (
        *(ours(task, *of_ours) for of_ours in OURS[task]),
        *(peer(task, of_peers) for of_peers in known.PEERS[task]),
    )
    for task in TASKS
}
"""All that are run with the first seed, ours first."""


def measure(task: str, learner: Learner, seed: int, stopping: threading.Event) -> Result | None:
    """A training until it reaches its target or its time is up; none if it was to stop.

    Raises:
      RuntimeError: if it ends by itself.
    """
    with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as parent:
        out, said = pathlib.Path(parent) / "run", pathlib.Path(parent) / "said"
        begun = time.monotonic()
        command = [*learner.command, "--seed", str(seed), "--out", str(out)]
        with _process(command, said, TASKS[task].limit) as process:
            while not stopping.wait(POLL):
                ended = process.poll() is not None
                rows = read_metrics(out / "metrics.csv")
                numbers = outcome(rows, time.monotonic() - begun, TASKS[task])
                if numbers:
                    return Result(task, learner.name, seed, *numbers, TASKS[task].limit)
                if ended:
                    text = said.read_text()[-2000:]
                    raise RuntimeError(f"{shlex.join(command)} ended by itself: {text}")
    return None


def outcome(
    rows: Sequence[Mapping[str, float]], seconds: float, task: Task
) -> tuple[float, float, float] | None:
    """Seconds, steps and return of a run that has these evaluations by now; none if it goes on.

    That is of the first evaluation whose return is the target at least, or, when the time is up, of
    the last one.
    """
    late = seconds > task.limit
    reaching = [] if late else [row for row in rows if row["return_mean"] >= task.target]
    if not reaching and not late:
        return None
    row = (reaching or [*rows[-1:], {}])[0]
    taken = seconds if reaching else math.inf
    return taken, row.get("env_steps", math.nan), row.get("return_mean", math.nan)


@contextlib.contextmanager
def _process(command: list[str], said: pathlib.Path, limit: float) -> Iterator[subprocess.Popen]:
    """With one thread and nothing compiled before; it is killed with the block.

    It never ends by itself, so that `timeout` ends it where we are killed before it.
    """
    environment = {
        **os.environ,
        "PYTHONPATH": str(commands.ROOT),
        "NPROC": "1",
        "JAX_COMPILATION_CACHE_DIR": str(said.parent / "compiled"),
    }
    with (
        said.open("w") as file,
        subprocess.Popen(
            ["timeout", "--signal=KILL", str(limit + 60), *command],
            cwd=commands.ROOT,
            env=environment,
            stdout=subprocess.DEVNULL,
            stderr=file,
            start_new_session=True,  # Ctrl-C reaches us alone
        ) as process,
    ):
        try:
            yield process
        finally:
            if process.poll() is None:
                os.killpg(process.pid, signal.SIGKILL)  # `timeout` and what it runs


def results(file: pathlib.Path) -> list[Result]:
    """The rows of the file."""
    return [
        Result(
            task,
            learner,
            int(seed),
            *(float(x or empty) for x, empty in zip(numbers, EMPTY, strict=True)),
        )
        for task, learner, seed, *numbers in csv_file.read(file)[1]
    ]


EMPTY = ("inf", "nan", "nan", "nan")
"""What an empty cell says, from `seconds` on."""


def as_row(result: Result) -> list[str]:
    """A row of the file."""
    formats = (".1f", ".0f", ".1f", "g")
    numbers = [
        f"{x:{how}}" if math.isfinite(x) else "" for x, how in zip(result[3:], formats, strict=True)
    ]
    return [result.task, result.learner, str(result.seed), *numbers]


def kept(task: str, found: Sequence[Result]) -> list[Learner]:
    """Those that go on beyond the first seed: all peers, and of ours the best two with it.

    One of the two has M = 10. None of ours goes on before each has run with the first seed.
    """
    first = {x.learner: x for x in found if x.task == task and x.seed == SEEDS[0]}
    own = [learner for learner in LEARNERS[task] if learner.heads]
    peers = [learner for learner in LEARNERS[task] if not learner.heads]
    if not all(learner.name in first for learner in own):
        return peers
    best, *others = sorted(own, key=lambda x: (first[x.name].seconds, -first[x.name].return_mean))
    second = [x for x in others if HEADS in (best.heads, x.heads)][:1]
    return [best, *second, *peers]


def missing(tasks: Sequence[str], seed: int, found: Sequence[Result]) -> list[tuple[str, Learner]]:
    """What is to be run with a seed."""
    done = {result[:3] for result in found}
    return [
        (task, learner)
        for task in tasks
        for learner in (LEARNERS[task] if seed == SEEDS[0] else kept(task, found))
        if (task, learner.name, seed) not in done
    ]


def train(tasks: Sequence[str], workers: int) -> None:
    """What is missing: every cell gets a seed before any gets its next."""
    lock, stopping = threading.Lock(), threading.Event()

    def one(task: str, learner: Learner, seed: int) -> None:
        result = None if stopping.is_set() else measure(task, learner, seed, stopping)
        if result is None:
            return
        with lock:
            rows = [as_row(x) for x in [*results(FILE), result]]
            csv_file.write(FILE, HEADER, rows)
            print(*rows[-1], flush=True)

    with concurrent.futures.ThreadPoolExecutor(workers) as pool:
        try:
            for seed in SEEDS:
                left = [
                    pool.submit(one, task, learner, seed)
                    for task, learner in missing(tasks, seed, results(FILE))
                ]
                for future in concurrent.futures.as_completed(left):
                    future.result()
        finally:
            stopping.set()
