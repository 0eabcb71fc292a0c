"""The settings that are published for each peer, as data: read here and in .venv-peers.

Of every library those two algorithms a task that its published settings make the fastest on one
thread: SAC and PPO, but for CrossQ where PPO's settings ask for a state-dependent noise that SBX
says it has not implemented properly. Left out: CrossQ's settings for MuJoCo (critics of 2,048
units) and DroQ's (20 updates a step), which ask for an accelerator.
"""

from collections.abc import Mapping
from typing import Any, NamedTuple

ZOO = "DLR-RM/rl-baselines3-zoo at 208b6fd, hyperparams"
"""RL Baselines3 Zoo, whose settings are for SBX too: its README sends there."""
README = "araffin/sbx at a7b3135, README"
CONFIG = "keraJLi/rejax at b33bab4, configs/gymnax/pendulum.yaml"
LIBRARIES = {"sb3": "Stable-Baselines3", "sbx": "SBX", "rejax": "rejax"}


class Known(NamedTuple):
    """A peer on one task."""

    library: str
    algorithm: str
    settings: Mapping[str, Any]
    """Of its constructor."""
    evaluate_every: int
    """Environment steps."""
    source: str
    """Of the settings: a repository, its commit and a file."""
    environments: int = 1
    normalize: bool = False
    """Observations and rewards by their running statistics, as the zoo's `normalize`."""


def _zoo(algorithm: str) -> str:
    return f"{ZOO}/{algorithm}.yml"


PENDULUM_SAC = {"learning_rate": 1e-3}
PENDULUM_PPO = {
    "n_steps": 1024,
    "gae_lambda": 0.95,
    "gamma": 0.9,
    "n_epochs": 10,
    "ent_coef": 0.0,
    "learning_rate": 1e-3,
    "clip_range": 0.2,
    "use_sde": True,
    "sde_sample_freq": 4,
}
PENDULUM_CROSSQ = {"policy_delay": 2, "policy_kwargs": {"net_arch": [256, 256]}}
MUJOCO_SAC = {"learning_starts": 10_000}
FOUR_AT_ONCE = {"train_freq": 4, "gradient_steps": 4}
"""Steps and updates in turns of four, which SBX jits together."""
MUJOCO_PPO_NETWORKS = {
    "log_std_init": -2,
    "ortho_init": False,
    "activation_fn": "relu",
    "net_arch": {"pi": [256, 256], "vf": [256, 256]},
}
HALFCHEETAH_PPO = {
    "batch_size": 64,
    "n_steps": 512,
    "gamma": 0.98,
    "learning_rate": 2.0633e-05,
    "ent_coef": 0.000401762,
    "clip_range": 0.1,
    "n_epochs": 20,
    "gae_lambda": 0.92,
    "max_grad_norm": 0.8,
    "vf_coef": 0.58096,
    "policy_kwargs": MUJOCO_PPO_NETWORKS,
}
HOPPER_PPO = {
    "batch_size": 32,
    "n_steps": 512,
    "gamma": 0.999,
    "learning_rate": 9.80828e-05,
    "ent_coef": 0.00229519,
    "clip_range": 0.2,
    "n_epochs": 5,
    "gae_lambda": 0.99,
    "max_grad_norm": 0.7,
    "vf_coef": 0.835671,
    "policy_kwargs": MUJOCO_PPO_NETWORKS,
}
REJAX_PPO = {
    "agent_kwargs": {"activation": "swish"},
    "num_envs": 100,
    "num_steps": 100,
    "num_epochs": 10,
    "num_minibatches": 10,
    "learning_rate": 0.001,
    "max_grad_norm": 10,
    "gamma": 0.995,
    "gae_lambda": 0.95,
    "clip_eps": 0.2,
    "ent_coef": 0.0,
    "vf_coef": 0.5,
    "normalize_observations": True,
}
REJAX_SAC = {
    "agent_kwargs": {"activation": "swish"},
    "num_envs": 1,
    "buffer_size": 10_000,
    "fill_buffer": 256,
    "batch_size": 256,
    "learning_rate": 0.01,
    "num_epochs": 1,
    "gamma": 0.99,
    "polyak": 0.98,
    "target_entropy_ratio": None,
    "normalize_observations": True,
}

PEERS: Mapping[str, tuple[Known, ...]] = {
    "pendulum": (
        Known("sb3", "SAC", PENDULUM_SAC, 250, _zoo("sac")),
        Known("sb3", "PPO", PENDULUM_PPO, 4_096, _zoo("ppo"), environments=4),
        Known("sbx", "SAC", PENDULUM_SAC, 500, _zoo("sac")),
        Known("sbx", "CrossQ", PENDULUM_CROSSQ, 500, _zoo("crossq")),
        Known("rejax", "SAC", REJAX_SAC, 1_000, CONFIG),
        Known("rejax", "PPO", REJAX_PPO, 10_000, CONFIG),
    ),
    "halfcheetah": (
        Known("sb3", "SAC", MUJOCO_SAC, 1_000, _zoo("sac")),
        Known("sb3", "PPO", HALFCHEETAH_PPO, 10_240, _zoo("ppo"), normalize=True),
        Known("sbx", "SAC", MUJOCO_SAC | FOUR_AT_ONCE, 2_000, f"{_zoo('sac')}, {README}"),
        Known("sbx", "PPO", HALFCHEETAH_PPO, 10_240, _zoo("ppo"), normalize=True),
    ),
    "hopper": (
        Known("sb3", "SAC", MUJOCO_SAC, 1_000, _zoo("sac")),
        Known("sb3", "PPO", HOPPER_PPO, 10_240, _zoo("ppo"), normalize=True),
        Known("sbx", "SAC", MUJOCO_SAC | FOUR_AT_ONCE, 2_000, f"{_zoo('sac')}, {README}"),
        Known("sbx", "PPO", HOPPER_PPO, 10_240, _zoo("ppo"), normalize=True),
    ),
}
"""By task."""
