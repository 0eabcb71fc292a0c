"""What can be set of MAPG: its numbers, and the rules of its heads."""

import dataclasses
from typing import Literal

from mapg_jax.algorithms.exploration import Noise
from mapg_jax.algorithms.options import Options, option

GradientRule = Literal["stored", "resampled", "all"]
"""Which heads an actor update reaches: the one that acted, a fresh one a sample, or all."""
TargetRule = Literal["mean", "sampled"]
"""What the target bootstraps from: the mean over the heads (Eq. 6), or one head drawn a sample."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class MapgOptions(Options):
    """The numbers of MAPG; the defaults are those of the code the paper ran on."""

    actor_learning_rate: float = option(1e-4, "Of Adam, for the actor.", above=0)
    critic_learning_rate: float = option(1e-3, "Of Adam, for the critic.", above=0)
    critic_l2: float = option(1e-2, "λ of the critic's weight penalty λ/2 Σ‖W‖².", at_least=0)
    tau: float = option(
        0.01, "τ, the step of the target networks: θ' ← θ' + τ(θ - θ').", above=0, at_most=1
    )
    max_gradient_norm: float | None = option(
        None, "Gradients are scaled down to this norm; none by default.", above=0
    )
    gradient: GradientRule = option(
        "stored",
        "Heads an actor update reaches: the one that acted, a fresh one per sample, or all.",
        of_heads=True,
    )
    target: TargetRule = option(
        "mean",
        "The target bootstraps from the mean over heads (Eq. 6) or from one head per sample.",
        of_heads=True,
    )
    noise: Noise = option(
        "ou",
        "Exploration noise added to the action: Ornstein-Uhlenbeck, Gaussian or none.",
    )
    noise_scale: float = option(0.2, "σ of the noise, in units of [-1, 1].", at_least=0)
    noise_scale_last: float | None = option(
        None,
        "σ in the last environment; those between take even steps. By default all have one σ.",
        at_least=0,
    )
