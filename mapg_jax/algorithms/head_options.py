"""Options of an actor with deterministic heads: how heads act, learn, and are kept apart.

docs/heads.md says what each rule is good for.
"""

import dataclasses
from collections.abc import Mapping
from typing import Any, Literal

import jax
from flax import struct

from mapg_jax.algorithms.exploration import Noise
from mapg_jax.algorithms.heads import Behaviour
from mapg_jax.algorithms.networks import LAST_LAYER_SCALE
from mapg_jax.algorithms.options import CriticOptions, option
from mapg_jax.algorithms.repulsion import Repulsion

GradientRule = Literal["stored", "resampled", "all"]
"""Which heads an actor update reaches: the one that acted, a fresh one a sample, or all."""
TargetRule = Literal["mean", "sampled", "max"]
"""What the target bootstraps from: the mean over the heads (Eq. 6), one drawn, or the best."""

WHOLE_EPISODE = 2**31 - 1  # steps; no episode is as long


@dataclasses.dataclass(frozen=True, kw_only=True)
class HeadOptions(CriticOptions):
    """The numbers of an actor with deterministic heads, and of the critic that they climb."""

    tau: float = option(
        0.01, "τ, the step of the target networks: θ' ← θ' + τ(θ - θ').", above=0, at_most=1
    )
    max_gradient_norm: float | None = option(
        None, "Gradients are scaled down to this norm; none by default.", above=0
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
    random_start: bool = option(
        False, "Before the first update, act by uniformly random actions instead of the heads."
    )
    gradient: GradientRule = option(
        "stored",
        "Heads an actor update reaches: the one that acted, a fresh one per sample, or all.",
        of_heads=True,
    )
    target: TargetRule = option(
        "mean",
        "The target bootstraps from the mean over heads (Eq. 6), from one head per sample, or from "
        "the one that the target critic values most.",
        of_heads=True,
    )
    behaviour: Behaviour = option(
        "uniform",
        "The head that acts in training: drawn uniformly, the best by the critic, or drawn by a "
        "softmax of its values.",
        of_heads=True,
    )
    temperature: float = option(
        1.0,
        "Of that softmax, in units of the standard deviation of Q over the actions at the state.",
        above=0,
        of_heads=True,
    )
    hold: int | Literal["episode"] = option(
        1, "Steps for which a head keeps acting, or episode.", at_least=1, of_heads=True
    )
    head_spread: float = option(
        LAST_LAYER_SCALE,
        "The heads' biases start within ± this, before the tanh.",
        above=0,
        of_heads=True,
    )
    repulsion: Repulsion = option(
        "none",
        "What keeps a state's proposals apart: nothing, Stein's direction, or inverse distance.",
        of_heads=True,
    )
    repulsion_weight: float = option(
        0.3,
        "α of the repulsion, in units of the standard deviation of Q over the actions at a state.",
        at_least=0,
        of_heads=True,
    )
    repulsion_updates: int = option(
        0,
        "Updates over which that weight falls to 0 in a straight line; 0 keeps it as it is.",
        at_least=0,
        of_heads=True,
    )
    floor: float | None = option(
        None,
        "A head is credited for what it adds to the heads before it, smoothed by this, in units of "
        "the standard deviation of Q over the actions at a state; none by default.",
        above=0,
        of_heads=True,
    )


DIVERSE: Mapping[str, Any] = {
    "gradient": "all",
    "hold": "episode",
    "head_spread": 1.0,
    "repulsion": "stein",
    "repulsion_weight": 0.5,
    "repulsion_updates": 500_000,  # half of the preset's
}
"""The preset of that name, found by the trials in docs/heads.md."""


class HeadNumbers(struct.PyTreeNode):
    """The traced ones, and what learning such heads reads besides."""

    heads: jax.Array  # [] i32, M
    discount: jax.Array  # [], γ
    tau: jax.Array  # [], τ
    actor_learning_rate: jax.Array  # []
    critic_learning_rate: jax.Array  # []
    noise_scale: jax.Array  # [], σ in the first environment
    noise_scale_last: jax.Array  # [], σ in the last one
    temperature: jax.Array  # [], in standard deviations of Q over actions
    hold: jax.Array  # [] i32 steps
    repulsion_weight: jax.Array  # [], in standard deviations of Q over actions
    repulsion_updates: jax.Array  # [] i32, until it is 0; 0 for never


def meant(options: HeadOptions) -> dict[str, Any]:
    """The traced numbers that are not written as they are meant."""
    last = options.noise_scale_last
    return {
        "noise_scale_last": options.noise_scale if last is None else last,
        "hold": WHOLE_EPISODE if options.hold == "episode" else options.hold,
    }
