"""One update, and one turn of collecting, in the checkout whose packages Python finds.

python benchmarks/turns.py [--quick] prints microseconds as JSON. `benchmarks.compare` runs it over
checkouts whose modules lie in other places.
"""

import argparse
import importlib
import json
import time
from collections.abc import Callable
from typing import Any

import jax
import numpy as np

TURNS, ROUNDS = 300, 9
FILLED = 200  # turns that fill the replay before an update is timed


def found(*places: str) -> Any:
    """The first of `module:name` that there is."""
    for place in places:
        module, name = place.split(":")
        try:
            return getattr(importlib.import_module(module), name)
        except ModuleNotFoundError:
            continue
    raise ImportError(f"none of {', '.join(places)}")


Config = found("mapg_jax.training.config:Config", "mapg_jax.config:Config")
make_trainer = found("mapg_jax.training.trainer:make_trainer", "mapg_jax.training:make_trainer")


class Subject:
    """A compiled loop of turns, and the state that it goes on from."""

    def __init__(self, step: Callable, state: Any, collecting: bool):
        def run(state, turns):
            def turn(_, state):
                key, *keys = jax.random.split(state.key, 3)
                return step(state.replace(key=key), *keys)

            return jax.lax.fori_loop(0, turns, turn, state)

        self._run = jax.jit(run, donate_argnums=0)
        self._collecting = collecting
        self._state = self._run(state, 1)

    def microseconds(self, turns: int) -> float:
        """Of one turn of collecting, or of one update."""
        before = float(self._state.totals.updates)
        begun = time.perf_counter()
        self._state = jax.block_until_ready(self._run(self._state, turns))
        seconds = time.perf_counter() - begun
        updates = float(self._state.totals.updates) - before
        return seconds / (turns if self._collecting else updates) * 1e6


def rooms(trainer: Any) -> Any:
    """Where `collect` and `learn` are: the trainer, or its kind of turn."""
    return trainer.turn if hasattr(trainer.turn, "collect") else trainer


def update(heads: int, layer_norm: bool) -> Subject:
    """Updates on batches of 64 from a replay of 100,000 slots; drawing them is included."""
    trainer = make_trainer(
        Config(env="halfcheetah", heads=heads, layer_norm=layer_norm, replay_size=100_000)
    )
    state = trainer.jitted_run(trainer.jitted_init(0), FILLED)
    return Subject(rooms(trainer).learn, state, collecting=False)


def collect(environments: int) -> Subject:
    """Steps of all environments, stored."""
    trainer = make_trainer(
        Config(env="halfcheetah", environments=environments, replay_size=100_000)
    )

    def step(state, key, _):
        return rooms(trainer).collect(state, key)

    return Subject(step, trainer.jitted_init(0), collecting=True)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--quick", action="store_true", help="only see that it runs")
    quick = parser.parse_args().quick
    subjects = {
        f"one update, M = {heads}, {'with' if layer_norm else 'no'} layer norm": update(
            heads, layer_norm
        )
        for heads in ((1,) if quick else (1, 10, 50))
        for layer_norm in (False, True)
    }
    for n in (1, 16):
        name = f"one turn of collecting, {n} environment{'s' if n > 1 else ''}"
        subjects[name] = collect(n)
    times = {name: [] for name in subjects}
    for _ in range(1 if quick else ROUNDS):
        for name, subject in subjects.items():
            times[name].append(subject.microseconds(10 if quick else TURNS))
    print(json.dumps({name: float(np.median(values)) for name, values in times.items()}))


if __name__ == "__main__":
    main()
