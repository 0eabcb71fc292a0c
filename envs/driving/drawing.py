"""Pictures of drives: the driven line as a PNG, and an animation as one HTML file."""

import json
from pathlib import Path
from string import Template

import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Float

from envs.driving.sensors import KMH
from envs.driving.tracks import Track
from envs.frames import Canvas, Picture

FRAMES_PER_SECOND = 25.0
DASH, DASHES_APART = 8.0, 20.0
"""m, of the line in the middle of a road, without which a car seems to stand still; so far apart
that none is taken for the one before it from one frame to the next."""
PLAYER = Path(__file__).with_name("player.html")


def draw_line(
    track: Track,
    positions: Float[ArrayLike, "T 2"],
    speeds: Float[ArrayLike, "T"],
    path: str | Path,
) -> None:
    """The driven line over the track, coloured by speed, as a PNG.

    Args:
      positions: m, of one car over time; `Drive.x` and `Drive.y`.
      speeds: m/s; `Drive.speed`.
    """
    from matplotlib.collections import LineCollection  # slow to import, and needed once a run
    from matplotlib.figure import Figure

    positions = np.asarray(positions)
    low, high = _bounds(track)
    wide, tall = high - low
    figure = Figure(figsize=(10, float(np.clip(10 * tall / wide, 3, 12))), layout="constrained")
    axes = figure.subplots()
    axes.fill(*_road(track).T, color="0.85", linewidth=0)
    for edge in (track.left, track.right):
        axes.plot(*_closed(edge).T, color="0.45", linewidth=0.8)
    axes.plot(*np.stack([track.left[0], track.right[0]]).T, color="black", linewidth=2)
    pieces = np.stack([positions[:-1], positions[1:]], 1)
    line = LineCollection(
        list(pieces), array=KMH * np.asarray(speeds)[1:], cmap="turbo", linewidth=1.6
    )
    axes.add_collection(line)
    figure.colorbar(line, ax=axes, label="speed, km/h", shrink=0.8)
    axes.set(title=track.name, xlabel="m", ylabel="m", aspect="equal")
    figure.savefig(path, dpi=120)


def animate(
    track: Track,
    positions: Float[ArrayLike, "T 2"],
    headings: Float[ArrayLike, "T"],
    speeds: Float[ArrayLike, "T"],
    dt: float,
    path: str | Path,
) -> None:
    """The drive as an animation in one HTML file, which a browser opens without a network.

    Args:
      positions: m, of one car over time; `Drive.x` and `Drive.y`.
      headings: rad; `Drive.heading`.
      speeds: m/s; `Drive.speed`.
      dt: s between two of them.
    """
    stride = max(1, round(1 / (FRAMES_PER_SECOND * dt)))
    frames = np.column_stack(
        [np.asarray(positions), np.unwrap(np.asarray(headings)), KMH * np.asarray(speeds)]
    )[::stride]
    drive = {
        "name": track.name,
        "dt": stride * dt,
        "left": track.left.round(2).tolist(),
        "right": track.right.round(2).tolist(),
        "frames": frames.astype(float).round(3).tolist(),
    }
    # A name may hold any text; "</" would end the script.
    data = json.dumps(drive, separators=(",", ":")).replace("</", "<\\/")
    page = Template(PLAYER.read_text(encoding="utf-8")).substitute(drive=data)
    Path(path).write_text(page, encoding="utf-8")


def _closed(points):
    return np.concatenate([points, points[:1]])


def _road(track: Track):
    """The surface as one polygon: along the left edge, and back along the right one."""
    return np.concatenate([_closed(track.left), _closed(track.right)[::-1]])


def _dashes(track: Track) -> Float[np.ndarray, "K 2 2"]:
    """The ends, m, of each dash of the line in the middle, evenly along the whole lap."""
    first = np.linspace(0.0, track.length, round(track.length / DASHES_APART), endpoint=False)
    ends = np.stack([first, first + DASH], -1)
    return np.stack([np.interp(ends, track.s, line, period=track.length)
                     for line in (track.x, track.y)], -1)  # fmt: skip


def _bounds(track: Track):
    edges = np.concatenate([track.left, track.right])
    return edges.min(0), edges.max(0)


def picture_of_car(
    track: Track, x: float, y: float, heading: float, width: int, height: int
) -> Picture:
    """The car and 25 m of road each way, from above.

    Args:
      track: that it is on.
      x: m.
      y: m.
      heading: rad.
      width: of the picture, in pixels.
      height: likewise.
    """
    centre, half = np.array([x, y]), 25.0 * np.array([width, height]) / min(width, height)
    canvas = Canvas(centre - half, centre + half, width, height)
    left, right = np.asarray(track.left), np.asarray(track.right)
    following = [np.roll(edge, -1, axis=0) for edge in (left, right)]
    near = np.linalg.norm((left + right) / 2 - centre, axis=-1) < 2 * half.max()
    for corners in np.stack([left, following[0], following[1], right], 1)[near]:
        canvas.polygon(corners, "#c8c8c8")
    for dash in _dashes(track):
        if np.linalg.norm(dash[0] - centre) < 2 * half.max():
            canvas.line(dash, "white", 0.3)
    canvas.line([left[0], right[0]], "black", 1.0)
    forward = np.array([np.cos(heading), np.sin(heading)])
    aside = np.array([-forward[1], forward[0]])
    box = [
        4.6 / 2 * a * forward + 1.9 / 2 * b * aside for a, b in ((1, 1), (1, -1), (-1, -1), (-1, 1))
    ]
    canvas.polygon(centre + np.array(box), "#b3402a")
    return canvas.picture()
