"""Steps a second of one run by the number of devices, forced out of this machine's cores."""

import os
import subprocess
import sys

DEVICES = (1, 2, 4, 8)
SHARDS = max(DEVICES)
PROGRAM = """
import sys, time
import jax
from mapg_jax.training.config import preset
from mapg_jax.training.lockstep import Lockstep

devices, turns = int(sys.argv[1]), int(sys.argv[2])
config = preset("paper", env="pendulum", environments=512, shards=8, batch_size=512,
                updates_per_step=1 / 512, learning_starts=512, replay_size=65_536)
program = Lockstep([config], devices)
state = jax.block_until_ready(program.jitted_run(program.init(), 8))
begun = time.perf_counter()
jax.block_until_ready(program.jitted_run(state, turns))
print(turns * 512 / (time.perf_counter() - begun))
"""


def report(quick: bool) -> str:
    """The section of the page."""
    cores = len(os.sched_getaffinity(0))
    lines = [
        f"## One run of {SHARDS} shards over devices",
        "",
        "Pendulum, 512 environments, batches of 512, one update a turn, on host devices that XLA "
        f"is told to have: they share {cores} cores, so that this shows that it "
        "runs and what the sharing costs, not what several accelerators would give.",
        "",
        "| devices | steps/s | of one |",
        "|---|---|---|",
    ]
    rates = {devices: _rate(devices, 8 if quick else 400) for devices in DEVICES}
    lines += [f"| {d} | {rate:,.0f} | {rate / rates[1]:.2f} |" for d, rate in rates.items()]
    return "\n".join(lines)


def _rate(devices: int, turns: int) -> float:
    flags = f"--xla_force_host_platform_device_count={max(DEVICES)}"
    environ = {**os.environ, "XLA_FLAGS": flags, "NPROC": "1"}
    command = [sys.executable, "-c", PROGRAM, str(devices), str(turns)]
    done = subprocess.run(command, env=environ, check=True, capture_output=True, text=True)
    return float(done.stdout.split()[-1])
