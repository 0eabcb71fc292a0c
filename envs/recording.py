"""What an environment is given to draw: episodes as they were played, and who played them."""

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float32


class Episode(NamedTuple):
    """One episode of T steps; the last of its T + 1 states is the one that ended it."""

    states: Any  # physics states, `State.pipeline_state` with leaves [T + 1, ...]
    observations: Float32[np.ndarray, "T+1 D"]
    actions: Float32[np.ndarray, "T A"]  # in [-1, 1]


class Player(NamedTuple):
    """The agent that played, asked about any observations."""

    proposals: Callable[
        [Float32[np.ndarray, "N D"]],
        tuple[Float32[np.ndarray, "N M A"], Float32[np.ndarray, "N M"]],
    ]
    """The M actions proposed for each, in [-1, 1], and the critic's value of every one."""
    q_values: Callable[
        [Float32[np.ndarray, "N D"], Float32[np.ndarray, "N K A"]], Float32[np.ndarray, "N K"]
    ]
    """The critic's values of any K actions for each."""
