"""Five circuits of our own, and random ones, whose measures span those of TORCS's road tracks."""

import math

import numpy as np
from jaxtyping import Bool, Complex, Float

from envs.driving.tracks import Arc, Segment, Straight, Track, from_segments, parse_segments

CIRCUITS: dict[str, tuple[float, str]] = {
    # name: (width m, segments); S* twice: the straights that close it
    "speedway": (
        15,
        """S357 L80/77.9 S100 L60/79.4 S125 L90/65.4 S66 R60/82.5 S149 L75/47.6 S* L60/74.6 S*
        L70/97.6 S238""",
    ),
    "road": (
        16,
        """S257 L90/46.6 S* R60/70.4 S* L50/55.5 S151 L45/81.8 S127 L90>60/43.4 L60>90/43.4 S110
        R60/77 S77 L80/92.5 S133 R60/91.3 S134 L50/78.1 S147 L60/84 S102 R90>60/42.9 R60>90/42.9
        S135 L45/95.6 S61 L60/63.6 S257""",
    ),
    "town": (
        10,
        """S145 R15.24/83.1 S73 L12.2/74.5 S67 L14/94.4 S* R18/76.8 S76 R15/93.9 S109 L12.2/81.4
        S92 L30/86.5 S145 L12.2/72.7 S73 R20/62.2 S86 L14/83.7 S* L36/51.2 S132 R12.2/94.2 S96
        L15/51.9 S90 R20/65.4 S99 L12.2/73.2 S93 L64/52 S119 L15/90.4 S106 R12.2/83.8 S57
        L20/107.5 S145""",
    ),
    "mountain": (
        12,
        """S205 L60/47.3 S127 L30/77.4 S111 R20/98.4 S64 R80/81.9 S69 L30/67.4 S28 R120/76.9 S66
        L30/83.2 S98 L40/79.7 S85 R200/50.1 S16 R30/80.7 S99 L50/80.2 S100 L30/67.9 S88
        L120>80/45.6 L80>120/45.6 S61 R20/76.3 S127 R40/70 S108 L30/80.7 S39 L150/86.6 S1 L30/67.5
        S105 R60/67.7 S104 R30/94.6 S115 R45/66.3 S88 L100/59.9 S104 L30/78.8 S107 L40/81.4 S101
        R70/61.4 S93 R20/92.3 S129 R60/49 S* L30/73.5 S98 L120>90/36.1 L90>120/36.1 S73 L30/81.2
        S133 R50/53.8 S122 L35/76.7 S144 R30/88.2 S65 R60/78.6 S* L40/60.9 S108 L30/91.9 S91
        R60/91.9 S68 L30/95.6 S54 L40/36.9 S205""",
    ),
    "eight": (
        12,
        """S167 R120/28.5 S* L60/45.5 S161 L40/53.1 S159 L50/56.5 S122 L80/79.9 S83 R45/57.3 S116
        L60/67.4 S153 L90/28.6 S* R120/35.7 S151 R60/58.6 S125 L45/67 S66 R30/82.3 S119 R50/65.5
        S128 R60/74.6 S165 L40/55.4 S71 R45/86.6 S124 L80/35.7 S167""",
    ),
}
NAMES = tuple(CIRCUITS)

LARGEST_RADIUS = 200.0  # m, of a random bend
ATTEMPTS = 200


def circuit(name: str) -> Track:
    """The circuit of this name, one of `NAMES`."""
    width, text = CIRCUITS[name]
    return from_segments(name, parse_segments(text), width)


def random_circuit(
    seed: int,
    length: float = 3000.0,
    width: float = 12.0,
    corners: int = 12,
    crossing: bool = False,
) -> Track:
    """A random circuit that closes, the same one for the same arguments.

    Its corners lie around a circle, at random distances from its middle, or around a figure-eight;
    each is rounded by an arc of a random radius.

    Args:
      length: m, about.
      crossing: a figure-eight, which crosses itself. Otherwise the road never meets itself.

    Raises:
      ValueError: if no such circuit was found, as where the length is too short for the corners.
    """
    rng = np.random.default_rng([seed, corners, crossing])
    for _ in range(ATTEMPTS):
        points = _random_corners(rng, corners, crossing)
        points *= length / np.abs(points - np.roll(points, 1)).sum()
        rounding = rng.uniform(0.4, 1.0, corners)
        segments = _round_corners(points, rounding, smallest=width)
        if segments is None:
            continue
        track = from_segments(f"random:{seed}", segments, width)
        if crossings(track).any() == crossing:
            return track
    raise ValueError(
        f"no random circuit of {corners} corners, {length:g} m and width {width:g} m in "
        f"{ATTEMPTS} attempts with seed {seed}"
    )


def _random_corners(rng, corners: int, crossing: bool) -> Complex[np.ndarray, "c"]:
    turn = 2 * np.pi * (np.arange(corners) + rng.uniform(-0.3, 0.3, corners)) / corners
    if crossing:
        shift = rng.uniform(-0.12, 0.12, (2, corners))
        return np.sin(turn) + shift[0] + 1j * (0.6 * np.sin(2 * turn) + shift[1])
    return rng.uniform(0.5, 1.3, corners) * np.exp(1j * turn)


def _round_corners(
    points: Complex[np.ndarray, "c"], rounding: Float[np.ndarray, "c"], smallest: float
) -> list[Segment] | None:
    """Straights and arcs along a polygon; None if a bend would be tighter than `smallest` m.

    Each arc takes up to 45 % of the shorter side next to it. The start is on the longest straight.
    """
    sides = np.roll(points, -1) - points  # [c], from each corner to the next
    angles = np.angle(sides / np.roll(sides, 1))
    room = 0.45 * np.minimum(np.abs(sides), np.abs(np.roll(sides, 1)))
    per_metre = np.tan(np.abs(angles) / 2)
    radii = np.minimum(rounding * room / np.maximum(per_metre, 1e-3), LARGEST_RADIUS)
    if radii.min() < smallest:
        return None
    taken = radii * per_metre
    straights = np.abs(sides) - taken - np.roll(taken, -1)
    first = int(np.argmax(straights))
    half = Straight(straights[first] / 2)
    segments: list[Segment] = [half]
    for k in np.roll(np.arange(len(points)), -first - 1):
        segments.append(Arc(radii[k], math.degrees(angles[k])))
        segments.append(half if k == first else Straight(straights[k]))
    return segments


def crossings(track: Track) -> Bool[np.ndarray, "e e"]:
    """Which of the straight pieces of the track's edges (left ones, then right ones) cross."""
    start = np.concatenate([track.left, track.right])
    end = np.concatenate([np.roll(edge, -1, 0) for edge in (track.left, track.right)])

    def side(points: np.ndarray):  # of each point against each piece
        along, to = end - start, points[None] - start[:, None]
        return np.sign(along[:, None, 0] * to[..., 1] - along[:, None, 1] * to[..., 0])

    apart = side(start) * side(end) < 0
    return apart & apart.T
