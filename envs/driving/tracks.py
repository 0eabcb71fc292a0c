"""Tracks: a closed centre line with widths, sampled into the nodes that everything else works on.

Between two nodes lies a cell, a quadrangle whose left and right sides are the edges of the road.
Cells are short where the road bends, so that the sides stay within centimetres of the true curve.
"""

import dataclasses
import math
import re
from collections.abc import Iterable

import numpy as np
from jaxtyping import Float

CAR_WIDTH = 1.94  # m
SAGITTA = 0.05  # m, between the centre line and the chord of a cell
LONGEST_CELL = 20.0  # m
SPIRAL_STEP = 8.0  # m, of the pieces of a spiral that does not say its own
LONGEST = 100_000.0  # m, of a track of a file
LARGEST_GAP = 1.0  # m, between the two ends of a track that still counts as closed
LARGEST_KINK = math.radians(1.0)  # rad, likewise


@dataclasses.dataclass(frozen=True)
class Straight:
    length: float
    """m; nan for the two straights of a circuit whose lengths close it."""


@dataclasses.dataclass(frozen=True)
class Arc:
    """A bend, or a spiral where its end has another radius."""

    radius: float
    """m, of the centre line, where it begins."""
    degrees: float
    """Anticlockwise (to the left) where positive."""
    end_radius: float | None = None
    """m; that of the beginning where None."""
    steps: int | None = None
    """Pieces of constant radius a spiral is made of; where None, one to each 8 m begun."""


Segment = Straight | Arc


@dataclasses.dataclass(frozen=True, eq=False)
class Track:
    """A closed road: nodes in driving order, the first one not repeated at the end.

    Raises:
      ValueError: if it is narrower than the car, or turns tighter than half its width.
    """

    name: str
    x: np.ndarray  # [n] m, centre line
    y: np.ndarray  # [n] m
    heading: np.ndarray  # [n] rad, anticlockwise, without jumps
    s: np.ndarray  # [n] m, along the centre line from the first node
    width: np.ndarray  # [n] m
    length: float  # m
    turn: float  # rad, that the heading gains in one lap: a multiple of 2π
    friction: float = 1.2  # of the tyres' own, of asphalt
    rolling_resistance: float = 0.001  # of the load

    def __post_init__(self):
        narrowest = int(np.argmin(self.width))
        if not self.width[narrowest] > CAR_WIDTH:
            raise ValueError(
                f"track {self.name!r} is {self.width[narrowest]:.2f} m wide at s = "
                f"{self.s[narrowest]:.0f} m, narrower than the car ({CAR_WIDTH} m)"
            )
        along = np.stack([np.cos(self.heading), np.sin(self.heading)], -1)
        steps = [np.roll(edge, -1, 0) - edge for edge in (self.left, self.right)]
        forward = np.minimum(*[(step * along).sum(-1) for step in steps])
        tightest = int(np.argmin(forward))
        if not forward[tightest] > 0:
            raise ValueError(
                f"track {self.name!r} turns tighter than half its width at s = "
                f"{self.s[tightest]:.0f} m"
            )

    @property
    def left(self) -> Float[np.ndarray, "n 2"]:
        """The left edge, m."""
        return self._offset(self.width / 2)

    @property
    def right(self) -> Float[np.ndarray, "n 2"]:
        """The right edge, m."""
        return self._offset(-self.width / 2)

    def _offset(self, left):
        x, y = self.x - left * np.sin(self.heading), self.y + left * np.cos(self.heading)
        return np.stack([x, y], -1)


def parse_segments(text: str) -> list[Segment]:
    """Segments from the short form `S120 L40/90 R30>80/45 S*`.

    S and a length; L or R and radius/degrees, radius>end radius/degrees for a spiral; `S*` twice,
    for the straights that close the circuit. Metres.
    """
    number = r"\d+(?:\.\d+)?"
    form = re.compile(rf"S({number}|\*)|([LR])({number})(?:>({number}))?/({number})")
    segments: list[Segment] = []
    for word in text.split():
        found = form.fullmatch(word)
        if not found:
            raise ValueError(f"{word!r} is no segment: S<m>, S*, or [LR]<m>[><m>]/<degrees>")
        straight, side, radius, end, degrees = found.groups()
        if straight:
            segments.append(Straight(math.nan if straight == "*" else float(straight)))
        else:
            turn = float(degrees) if side == "L" else -float(degrees)
            segments.append(Arc(float(radius), turn, float(end) if end else None))
    return segments


def from_segments(
    name: str,
    segments: Iterable[Segment],
    width: float,
    friction: float = 1.2,
    rolling_resistance: float = 0.001,
) -> Track:
    """The track that starts at the origin, eastwards, and follows the segments.

    A gap of less than a metre between its ends, as rounded numbers leave, is spread over the lap.

    Raises:
      ValueError: if a segment has no length, or the track does not close.
    """
    pieces = _close(name, [piece for segment in segments for piece in _pieces(segment)])
    lengths, angles = (np.array(column) for column in zip(*pieces, strict=True))
    cells = [_cells(length, angle) for length, angle in pieces]
    # Every piece bends evenly, so its nodes have closed forms.
    share = np.concatenate([np.arange(n) / n for n in cells])
    piece = np.repeat(np.arange(len(pieces)), cells)
    start_heading = np.cumsum(angles) - angles
    corners = _corners(lengths, angles)
    turned, driven = share * angles[piece], share * lengths[piece]
    offset = _chord(driven, turned) * np.exp(1j * start_heading[piece])
    s = (np.cumsum(lengths) - lengths)[piece] + driven
    position = corners[:-1][piece] + offset

    length, turn = float(lengths.sum()), float(angles.sum())
    gap, kink = corners[-1], wrap(turn)
    if abs(gap) > LARGEST_GAP or abs(kink) > LARGEST_KINK:
        raise ValueError(
            f"track {name!r} does not close: its end misses its start by {abs(gap):.2f} m "
            f"and {math.degrees(abs(kink)):.2f} degrees"
        )
    position = position - gap * s / length
    heading = start_heading[piece] + turned - kink * s / length
    widths = np.full(len(s), float(width))
    x, y = position.real, position.imag
    ends = (length, turn - kink)
    return Track(name, x, y, heading, s, widths, *ends, friction, rolling_resistance)


def wrap(angle: float) -> float:
    """The same angle in [-π, π]."""
    return math.remainder(angle, 2 * math.pi)


def _pieces(segment: Segment) -> list[tuple[float, float]]:
    """(length m, angle rad) of the pieces of even curvature that make up a segment.

    A spiral has pieces of equal length whose radii run evenly from the first to the last, as in
    TORCS.
    """
    if isinstance(segment, Straight):
        if segment.length <= 0:
            raise ValueError(f"a straight must be longer than 0 m, got {segment.length}")
        return [(segment.length, 0.0)]
    end = segment.radius if segment.end_radius is None else segment.end_radius
    angle = math.radians(segment.degrees)
    if not (segment.radius > 0 and end > 0 and abs(angle) > 0):
        raise ValueError(f"an arc needs radii and an angle above 0, got {segment}")
    steps = 1
    if end != segment.radius:
        steps = segment.steps or int((segment.radius + end) / 2 * abs(angle) / SPIRAL_STEP) + 1
    radii = np.linspace(segment.radius, end, steps)
    length = abs(angle) / (1 / radii).sum()
    return [(length, math.copysign(length / radius, angle)) for radius in radii]


def _close(name: str, pieces: list[tuple[float, float]]) -> list[tuple[float, float]]:
    """The pieces with the two open straights given the lengths that close the circuit."""
    lengths, angles = (np.array(column) for column in zip(*pieces, strict=True))
    (open_,) = np.nonzero(np.isnan(lengths))
    if not len(open_):
        return pieces
    if len(open_) != 2:
        raise ValueError(f"track {name!r} must have no or two open straights, has {len(open_)}")
    lengths[open_] = 0.0
    headings = (np.cumsum(angles) - angles)[open_]
    gap = _corners(lengths, angles)[-1]
    directions = np.stack([np.cos(headings), np.sin(headings)])
    if abs(np.linalg.det(directions)) < 1e-6:
        raise ValueError(f"the open straights of track {name!r} are parallel: they cannot close it")
    lengths[open_] = -np.linalg.solve(directions, [gap.real, gap.imag])
    if lengths[open_].min() <= 0:
        raise ValueError(
            f"track {name!r} closes only with straights of {lengths[open_].round(1).tolist()} m"
        )
    return list(zip(lengths.tolist(), angles.tolist(), strict=True))


def _chord(length, angle):
    """Where an even bend of this length and angle ends, from 0, eastwards; complex."""
    half = angle / 2
    return length * np.sinc(half / np.pi) * np.exp(1j * half)


def _corners(lengths, angles) -> np.ndarray:
    """[n + 1] complex, where the pieces begin and the last one ends."""
    start_heading = np.cumsum(angles) - angles
    steps = _chord(lengths, angles) * np.exp(1j * start_heading)
    return np.concatenate([[0], np.cumsum(steps)])


def _cells(length: float, angle: float) -> int:
    """The number of cells that keeps each within `SAGITTA` and `LONGEST_CELL`."""
    flat = math.sqrt(8 * SAGITTA * length / abs(angle)) if angle else math.inf
    return max(1, math.ceil(length / min(flat, LONGEST_CELL)))
