"""What a run was made by: the same bits come again on the same machine, by the same code."""

import contextlib
import os
import pathlib
import platform
import subprocess
from typing import Any

import jax

from envs.engines.simulators import cpus

CODE = ("mapg_jax", "envs")
"""Folders of a checkout whose changes bear on a run."""
EXTENSIONS = ("sse4_2", "avx", "avx2", "fma", "avx512f", "avx512_bf16", "amx_tile", "neon", "sve")
"""Of a processor's instruction set, those that decide which programs XLA makes."""

PRECISION = "highest"
"""Of matrix products in float32, where JAX's own setting names none: accelerators would take
TF32 or bfloat16 for them, which harms the physics and the learning (MuJoCo Playground, #86)."""


def precise() -> contextlib.AbstractContextManager:
    """What is compiled within multiplies matrices with `precision()`."""
    return jax.default_matmul_precision(precision())


def precision() -> str:
    """JAX_DEFAULT_MATMUL_PRECISION, or ours."""
    settings: Any = jax.config  # JAX gives it its attributes at run time
    return str(settings.jax_default_matmul_precision or PRECISION)


def this_host(engine: str, devices: int = 1) -> dict[str, str]:
    """What is recorded of the process that trains, as text; '' where the platform does not tell.

    Args:
      engine: of the physics, which `auto` chose.
      devices: D, of the run.
    """
    return {
        "processor": processor(),
        "instructions": instructions(),
        "commit": commit(),
        "threads": os.environ.get("NPROC", str(cpus())),  # of XLA
        "engine": engine,
        "devices": str(devices),  # sums over shards are taken in their order
        "precision": precision(),  # of matrix products
    }


def processor() -> str:
    """Its model, with the accelerator where there is one."""
    device = jax.devices()[0]
    names = [_cpuinfo("model name") or platform.processor()]
    if device.platform != "cpu":
        names.append(device.device_kind)
    return " with ".join(filter(None, names))


def instructions() -> str:
    """Architecture, and those of EXTENSIONS that it has."""
    flags = (_cpuinfo("flags") or _cpuinfo("Features")).split()
    return " ".join([platform.machine(), *(name for name in EXTENSIONS if name in flags)])


def commit() -> str:
    """Of the checkout that this package is in, with `+` where its code was changed since."""
    root = pathlib.Path(__file__).parents[2]
    if not (root / ".git").exists():
        return ""
    number = _git(root, "rev-parse", "--short=12", "HEAD")
    return number + ("+" if number and _git(root, "status", "--porcelain", "--", *CODE) else "")


def _git(root: pathlib.Path, *arguments: str) -> str:
    """What it prints; '' where it fails or is not installed."""
    try:
        done = subprocess.run(["git", "-C", root, *arguments], capture_output=True, text=True)
    except OSError:
        return ""
    return done.stdout.strip() if done.returncode == 0 else ""


def _cpuinfo(name: str) -> str:
    """The first such line of what Linux tells of its processors; '' elsewhere."""
    file = pathlib.Path("/proc/cpuinfo")
    lines = file.read_text(errors="replace").splitlines() if file.exists() else []
    return next((line.partition(":")[2].strip() for line in lines if line.startswith(name)), "")
