"""Driving: control steps a second, what the track's length costs, and the time to compile."""

import time

import jax
import numpy as np

from envs.driving import Driving, Track, from_segments, parse_segments, scripted_driver

INSTANCES = 1024
STEPS = 50
ROUNDS = 9
WANTED_RATE, WANTED_GROWTH, WANTED_COMPILE = 200_000, 1.1, 15.0


def square(chicanes: int) -> Track:
    """A square whose sides have this many chicanes: the same bends at any length."""
    side = chicanes * "S100 L60/40 R60/80 L60/40 " + "S100 L60/90 "
    return from_segments(f"square of {chicanes}", parse_segments(4 * side), 12.0)


def program(track: str | Track):
    """Compiled `STEPS` steps of all instances under the scripted driver, spread over the track.

    Returns the program, the states to begin with, and the seconds that compiling took.
    """
    env = Driving(track, start="anywhere", off_track_end=None, backwards_end=None, slow_end=None)
    policy = scripted_driver(env.ray_angles)

    def step(states, _):
        actions = jax.vmap(policy)(states.obs)
        return jax.vmap(env.step)(states, actions), None

    @jax.jit
    def run(states):
        return jax.lax.scan(step, states, length=STEPS)[0]

    states = jax.jit(jax.vmap(env.reset))(jax.random.split(jax.random.key(0), INSTANCES))
    begun = time.perf_counter()
    compiled = run.lower(states).compile()
    seconds = time.perf_counter() - begun
    return compiled, jax.block_until_ready(compiled(states)), seconds


def measure() -> dict[str, float]:
    """Medians over interleaved rounds; the growth is the median of the rounds' ratios."""
    short, long = square(1), square(6)
    programs = {"speedway": program("speedway"), "short": program(short), "long": program(long)}
    seconds = {name: [] for name in programs}
    for _ in range(ROUNDS):
        for name, (compiled, states, _) in programs.items():
            begun = time.perf_counter()
            jax.block_until_ready(compiled(states))
            seconds[name].append(time.perf_counter() - begun)
    ratio = np.array(seconds["long"]) / np.array(seconds["short"])
    return {
        "rate": INSTANCES * STEPS / float(np.median(seconds["speedway"])),
        "length": long.length / short.length,
        "growth": float(np.median(ratio)),
        "compile": programs["speedway"][2],
    }


def report() -> str:
    """The table, in Markdown."""
    found = measure()
    real_time = found["rate"] * Driving().dt
    return "\n".join(
        [
            f"## Driving: {INSTANCES} cars on the speedway, 50 Hz control, all sensors",
            "",
            "| | measured | wanted |",
            "|---|---|---|",
            f"| control steps/s | {found['rate']:,.0f} | {WANTED_RATE:,} |",
            f"| times real time | {real_time:,.0f} | |",
            f"| time of {found['length']:.1f} times the length | {found['growth']:.2f} "
            f"| at most {WANTED_GROWTH} |",
            f"| compile, s | {found['compile']:.1f} | under {WANTED_COMPILE:.0f} |",
        ]
    )


def main() -> None:
    print(report())


if __name__ == "__main__":
    main()
