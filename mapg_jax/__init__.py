"""Multiple Action Policy Gradients in JAX.

folder = mapg_jax.train(mapg_jax.Config(env="hopper", heads=10, steps=100_000))
policy = mapg_jax.load_policy(folder.path, seed=0, select="uniform")
action = policy(observation)
"""

from mapg_jax.runs.policy import Policy, load_policy
from mapg_jax.runs.runner import resume, train
from mapg_jax.runs.scoring import evaluate
from mapg_jax.training.config import PRESETS, Config

__all__ = ["PRESETS", "Config", "Policy", "evaluate", "load_policy", "resume", "train"]
