"""Every number of a run, with its meaning; and the presets."""

import ast
import dataclasses
import math
import typing
from typing import Any, Literal

import envs
from envs.values import fits
from mapg_jax.algorithms.exploration import Noise
from mapg_jax.algorithms.mapg import GradientRule, TargetRule

Algorithm = Literal["mapg", "a3c"]


@dataclasses.dataclass(frozen=True)
class Config:
    """One training run. The defaults are the preset `paper`."""

    env: str = "pendulum"
    """Environment: a name of `mapg envs`, or brax:NAME."""
    env_options: tuple[str, ...] = ()
    """Options of the environment, as name=value."""
    engine: str = "auto"
    """Physics engine: native (MuJoCo's C engine), mjx, jax (tasks in pure JAX), or auto."""
    time_limit: int | None = None
    """Steps after which an episode is truncated; by default Gymnasium's."""
    algorithm: Algorithm = "mapg"
    """mapg, which is DDPG where M = 1, or a3c, the paper's baseline (docs/a3c.md)."""
    heads: int = 10
    """M, the actions proposed per state; 1 is DDPG. A3C proposes one, whatever is given here."""
    seed: int = 0
    """Of every random draw of the run."""
    steps: int = 2_000_000
    """Environment steps, all environments together."""

    environments: int = 16
    """N, environments stepped side by side; the paper had one."""
    updates_per_step: float = 0.5
    """Updates per environment step."""
    learning_starts: int = 100
    """Environment steps before the first update."""
    replay_size: int = 1_000_000
    """C, transitions kept."""
    batch_size: int = 64
    """B, transitions per update."""

    hidden: tuple[int, ...] = (64, 64)
    """Widths of the hidden layers of actor and critic; at least two."""
    layer_norm: bool = True
    """Layer norm before each ReLU, as in the code the paper ran on."""
    normalize: bool = True
    """Normalise observations by their running mean and standard deviation."""
    observation_clip: float = 5.0
    """Bound of normalised observations."""

    actor_learning_rate: float = 1e-4
    """Of Adam, for the actor."""
    critic_learning_rate: float = 1e-3
    """Of Adam, for the critic."""
    critic_l2: float = 1e-2
    """λ of the critic's weight penalty λ/2 Σ‖W‖²."""
    discount: float = 0.99
    """γ, per environment step, in [0, 1)."""
    tau: float = 0.01
    """τ, the step of the target networks: θ' ← θ' + τ(θ - θ')."""
    max_gradient_norm: float | None = None
    """Gradients are scaled down to this norm; none by default."""
    gradient: GradientRule = "stored"
    """Heads an actor update reaches: the one that acted, a fresh one per sample, or all."""
    target: TargetRule = "mean"
    """The target bootstraps from the mean over heads (Eq. 6) or from one head per sample."""
    truncation: Literal["bootstrap", "terminal"] = "bootstrap"
    """At the time limit: bootstrap, or treat it as an end as the 2017 code did."""

    noise: Noise = "ou"
    """Exploration noise added to the action: Ornstein-Uhlenbeck, Gaussian or none."""
    noise_scale: float = 0.2
    """σ of the noise, in units of [-1, 1]."""
    noise_scale_last: float | None = None
    """σ in the last environment; those between take even steps. By default all have one σ."""

    a3c_rollout_steps: int = 10
    """A3C: n, steps of every environment between updates; N · n make a batch."""
    a3c_actor_learning_rate: float = 1e-4
    """A3C: of Adam, for the actor."""
    a3c_critic_learning_rate: float = 1e-2
    """A3C: of Adam, for the critic."""
    a3c_max_gradient_norm: float | None = 0.5
    """A3C: the gradient of each network is scaled down to this norm."""
    a3c_entropy_weight: float = 1e-4
    """A3C: β, of the entropy of the action's distribution, as in the paper."""

    evaluate_every: int = 20_000
    """Environment steps between evaluations; rounded to whole turns of all environments."""
    evaluation_episodes: int = 10
    """Episodes per evaluation."""
    final_episodes: int = 100
    """Episodes of the evaluation after training."""
    checkpoint_seconds: float = 300.0
    """Time between checkpoints."""
    checkpoints_kept: int = 2
    """Newest checkpoints kept."""

    def __post_init__(self):
        for name, hint in typing.get_type_hints(Config).items():
            value, choices = getattr(self, name), typing.get_args(hint)
            if typing.get_origin(hint) is Literal and value not in choices:
                raise ValueError(f"{name} must be one of {', '.join(choices)}, got {value!r}")
            if not fits(value, hint):
                expected = hint.__name__ if isinstance(hint, type) else hint
                raise ValueError(f"{name} must be {expected}, got {value!r}")
            if isinstance(value, float) and not math.isfinite(value):
                raise ValueError(f"{name} must be finite, got {value}")
        if self.algorithm == "a3c":
            # Equal runs are equal configurations: what tells arms of MAPG apart means nothing here.
            object.__setattr__(self, "heads", 1)
            for name in ("noise", "noise_scale", "noise_scale_last", "gradient", "target"):
                object.__setattr__(self, name, getattr(Config, name))
        at_least = {
            "heads": 1, "seed": 0, "steps": 1, "environments": 1, "updates_per_step": 1e-5,
            "learning_starts": 0, "replay_size": 1, "batch_size": 1, "evaluate_every": 1,
            "evaluation_episodes": 1, "final_episodes": 1, "checkpoints_kept": 1, "critic_l2": 0,
            "noise_scale": 0, "noise_scale_last": 0, "time_limit": 1,
            "a3c_rollout_steps": 1, "a3c_entropy_weight": 0,
        }  # fmt: skip
        for name, least in at_least.items():
            value = getattr(self, name)
            if value is not None and value < least:
                raise ValueError(f"{name} must be at least {least}, got {value}")
        at_most = {"seed": 2**31 - 1, "steps": 2_000_000_000, "tau": 1}  # counters are int32
        for name, most in at_most.items():
            if getattr(self, name) > most:
                raise ValueError(f"{name} must be at most {most}, got {getattr(self, name)}")
        positive = ("observation_clip", "checkpoint_seconds", "tau", "actor_learning_rate",
                    "critic_learning_rate", "max_gradient_norm", "a3c_actor_learning_rate",
                    "a3c_critic_learning_rate", "a3c_max_gradient_norm")  # fmt: skip
        for name in positive:
            value = getattr(self, name)
            if value is not None and value <= 0:
                raise ValueError(f"{name} must be above 0, got {value}")
        if not 0 <= self.discount < 1:
            raise ValueError(f"discount must be in [0, 1), got {self.discount}")
        if len(self.hidden) < 2 or min(self.hidden) < 1:
            raise ValueError(
                f"hidden must be two widths or more, each at least 1, got {self.hidden}"
            )
        if self.batch_size > self.replay_size:
            raise ValueError(
                f"a batch of {self.batch_size} is larger than the replay of {self.replay_size}"
            )
        if self.environments > self.replay_size:
            raise ValueError(
                f"{self.environments} environments do not fit a replay of {self.replay_size}"
            )
        self.parsed_env_options()

    def parsed_env_options(self) -> dict[str, Any]:
        """`env_options` as keyword arguments of `envs.make`."""
        options = {}
        for text in self.env_options:
            name, equals, value = text.partition("=")
            if not name or not equals:
                raise ValueError(f"env_options are written name=value, got {text!r}")
            if name == "engine":
                raise ValueError("the engine is no option of an environment; choose it by --engine")
            try:
                options[name] = ast.literal_eval(value)
            except (ValueError, SyntaxError):
                options[name] = value
        return options

    def make_env(self, engine: str | None = None) -> envs.Env:
        """The bare environment of the run."""
        return envs.make(self.env, engine or self.engine, **self.parsed_env_options())

    def episode_steps(self) -> int:
        """The time limit in force."""
        return self.time_limit or envs.spec(self.env).time_limit


Preset = Literal["paper", "parallel", "smoke"]
PRESETS: dict[Preset, Config] = {
    "paper": Config(),
    "parallel": Config(
        # Thousands of environments on an accelerator: the proportions of PQL's DDPG
        # (Li et al. 2023): 16 samples per environment step, fast targets, a ladder of noise.
        engine="mjx",
        steps=50_000_000,
        environments=4096,
        updates_per_step=8 / 4096,
        learning_starts=4096 * 32,
        replay_size=2_000_000,
        batch_size=8192,
        hidden=(256, 256),
        actor_learning_rate=5e-4,
        critic_learning_rate=5e-4,
        critic_l2=0.0,
        tau=0.05,
        max_gradient_norm=0.5,
        noise="gaussian",
        noise_scale=0.05,
        noise_scale_last=0.8,
        evaluate_every=2_000_000,
        evaluation_episodes=128,
    ),
    "smoke": Config(
        heads=3,
        steps=2_000,
        environments=4,
        replay_size=10_000,
        batch_size=16,
        hidden=(16, 16),
        evaluate_every=1_000,
        evaluation_episodes=2,
        final_episodes=4,
    ),
}
"""Named configurations: the paper's set-up, one for accelerators, one that ends in seconds."""
