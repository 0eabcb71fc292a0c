"""Multiple Action Policy Gradients in JAX.

trained = mapg_jax.train(mapg_jax.Config(env="hopper", heads=10, steps=100_000))
policy = mapg_jax.load_policy(trained.path, seed=0, select="uniform")
action = policy(observation)
"""

import importlib
from typing import TYPE_CHECKING, Any

from mapg_jax import foreign, registration

if TYPE_CHECKING:
    from mapg_jax.algorithms.registry import find as find_algorithm
    from mapg_jax.algorithms.registry import register
    from mapg_jax.runs.policy import Policy, load_policy
    from mapg_jax.runs.scoring import evaluate
    from mapg_jax.runs.train import Event, Trained, resume, train
    from mapg_jax.training.config import PRESETS, Config, preset

_PUBLIC = {
    "Config": "training.config.Config",
    "PRESETS": "training.config.PRESETS",
    "Policy": "runs.policy.Policy",
    "Event": "runs.train.Event",
    "Trained": "runs.train.Trained",
    "evaluate": "runs.scoring.evaluate",
    "find_algorithm": "algorithms.registry.find",
    "load_policy": "runs.policy.load_policy",
    "preset": "training.config.preset",
    "register": "algorithms.registry.register",
    "resume": "runs.train.resume",
    "train": "runs.train.train",
}
__all__ = [
    "PRESETS",
    "Config",
    "Event",
    "Policy",
    "Trained",
    "evaluate",
    "find_algorithm",
    "load_policy",
    "preset",
    "register",
    "resume",
    "train",
]


def __getattr__(name: str) -> Any:
    """Public names are imported when they are first used: `mapg --help` needs no JAX."""
    if name not in _PUBLIC:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    foreign.refuse("envs")
    module, _, attribute = _PUBLIC[name].rpartition(".")
    return getattr(importlib.import_module(f"{__name__}.{module}"), attribute)


registration.with_gymnasium()
