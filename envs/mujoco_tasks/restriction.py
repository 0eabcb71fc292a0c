"""Restricted actions: a task that takes some actions only, as in Q3C and SAVO."""

import math

import numpy as np
from jaxtyping import Float32

CENTRES = 33
"""Balls for each number of an action."""
SHARE = 0.6
"""Volume of all balls for each number of an action, where K is 1, over that of all actions."""
SEED = 123
GRAIN = 2.0**-24
"""Between float32 actions of a size near 1, in [0, 1]."""


class Balls:
    r"""The actions that are valid: those within balls of $[0, 1]^A$, into which they are scaled.

    The 33 A centres are drawn uniformly by `numpy.random.RandomState(123)`. The radius is that of
    an A-ball of volume $0.6 K / 33$ (Q3C, `mujoco_env_gymnasium.py`):
    $r = \frac{1}{\sqrt\pi} (\frac{0.6 K}{33} \Gamma(\frac{A}{2} + 1))^{1/A}$.
    """

    def __init__(self, k: float, size: int):
        """The balls of K for actions of A numbers.

        Raises:
          ValueError: if K is not above 0 and finite, or the balls lie between float32 actions.
        """
        if not (k > 0 and math.isfinite(k)):
            raise ValueError(f"restricted must be True or K above 0 and finite, got {k}")
        centres = np.random.RandomState(SEED).random_sample((CENTRES * size, size))
        self.centres: Float32[np.ndarray, "C A"] = centres.astype(np.float32)
        log_volume = math.log(SHARE * k / CENTRES)
        self.radius = math.exp((log_volume + math.lgamma(size / 2 + 1)) / size) / math.sqrt(math.pi)
        if self.radius < GRAIN * math.sqrt(size):
            raise ValueError(
                f"restricted={k:g} leaves no valid action: its balls have radius {self.radius:.1g} "
                f"of the range, and float32 tells actions apart by {GRAIN:.1g}; choose a larger K"
            )

    def hold(self, xp, place):
        """Whether places of [0, 1]^A lie in a ball: [*B] bool, of [*B, A] in the namespace `xp`."""
        squares = xp.square(place[..., None, :] - self.centres).sum(-1)
        return (squares < np.float32(self.radius) ** 2).any(-1)


def scaled(action):
    """An action of [-1, 1]^A in [0, 1]^A."""
    return (action + 1) / 2
