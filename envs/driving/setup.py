"""What of a car can be changed: factors of its own numbers, the same or drawn for each episode."""

from typing import NamedTuple

import jax
from jaxtyping import Array, Float


class Setup(NamedTuple):
    """Factors of the numbers of car1-trb1; 1 for the car as it is."""

    mass: Float[Array, ""] | float = 1.0
    """Of 1244 kg, and of the moment of inertia with it."""
    power: Float[Array, ""] | float = 1.0
    """Of the engine's torque at every speed (405 kW), its own braking included."""
    brakes: Float[Array, ""] | float = 1.0
    """Of the brakes' torque."""
    grip: Float[Array, ""] | float = 1.0
    """Of the friction under the tyres, 1.2 on asphalt."""
    drag: Float[Array, ""] | float = 1.0
    """Of the drag of 0.67 N s²/m²; the downforce stays."""


AS_IT_IS = Setup()


def drawn(key: jax.Array, about: Setup, share: float) -> Setup:
    """Each factor uniform within ± `share` of what it is in `about`."""
    factors = jax.random.uniform(key, (len(about),), minval=1 - share, maxval=1 + share)
    return Setup(*(value * factor for value, factor in zip(about, factors, strict=True)))
