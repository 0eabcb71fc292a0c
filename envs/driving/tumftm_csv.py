"""Tracks from points along a lap, as in the TUMFTM race track database."""

import math
from pathlib import Path

import numpy as np
from jaxtyping import Float

from envs.driving.tracks import LONGEST, LONGEST_CELL, SAGITTA, Track

CSV_COLUMNS = ("x_m", "y_m", "w_tr_right_m", "w_tr_left_m")
LARGEST_STEP_BACK = 3.0  # from the last point of a CSV to its first, of its longest step
GRID, SMOOTHING = 0.5, 4.0  # m along the track: of samples, and the standard deviation


def read_csv(path: Path) -> Track:
    """The track of a TUMFTM file: x_m, y_m, w_tr_right_m, w_tr_left_m of points along a lap.

    The middle between the edges is smoothed; the start is its first point.
    """
    points = _csv_points(path)
    right, left = points.T[2:]
    ahead = np.roll(points[:, :2], -1, 0) - np.roll(points[:, :2], 1, 0)
    to_left = np.stack([-ahead[:, 1], ahead[:, 0]], -1)
    to_left /= np.maximum(np.linalg.norm(ahead, axis=-1, keepdims=True), 1e-9)
    middle = points[:, :2] + to_left * ((left - right) / 2)[:, None]
    return from_points(path.stem, middle, left + right)


def _csv_points(path: Path) -> np.ndarray:
    """[n, 4] of the file; a last point that repeats the first is dropped."""
    rows = []
    for number, line in enumerate(path.read_text().splitlines(), 1):
        fields = [field.strip() for field in line.split(",")]
        if line.lstrip().startswith("#") or not line.strip() or tuple(fields) == CSV_COLUMNS:
            continue
        try:
            row = [float(field) for field in fields]
        except ValueError:
            row = []
        if len(row) != len(CSV_COLUMNS) or not np.isfinite(row).all():
            columns = ",".join(CSV_COLUMNS)
            raise ValueError(f"{path}, line {number}: {line.strip()!r} is not {columns}")
        rows.append(row)
    points = np.array(rows).reshape(-1, 4)
    if len(points) > 1 and np.allclose(points[0, :2], points[-1, :2]):
        points = points[:-1]
    if len(points) < 8:
        raise ValueError(f"{path}: a track needs at least 8 points, got {len(points)}")
    steps = np.linalg.norm(np.roll(points[:, :2], -1, 0) - points[:, :2], axis=-1)
    if steps.min() == 0:
        raise ValueError(f"{path}: point {int(np.argmin(steps)) + 1} is repeated")
    if steps[-1] > LARGEST_STEP_BACK * steps[:-1].max():
        raise ValueError(
            f"{path}: the track does not close, its last point lies {steps[-1]:.1f} m "
            f"from its first"
        )
    if steps.sum() > LONGEST:
        raise ValueError(f"{path}: a lap is {steps.sum():,.0f} m long, more than {LONGEST:,.0f}")
    return points


def from_points(
    name: str, middle: Float[np.ndarray, "n 2"], width: Float[np.ndarray, "n"]
) -> Track:
    """The track along a smooth curve near these points, m, the first one not repeated.

    The polygon through the points is smoothed by a Gaussian along it: no curve overshoots, where
    a spline through points 5 m apart would make a hairpin tighter than it is.
    """
    loop = np.concatenate([middle, middle[:1]])
    at = _running(np.linalg.norm(np.diff(loop, axis=0), axis=-1))
    n = math.ceil(at[-1] / GRID)
    even = np.arange(n) * at[-1] / n
    polygon = np.interp(even, at, loop[:, 0]) + 1j * np.interp(even, at, loop[:, 1])
    frequency = 2 * np.pi * np.fft.fftfreq(n, at[-1] / n)
    spectrum = np.fft.fft(polygon) * np.exp(-((frequency * SMOOTHING) ** 2) / 2)
    curve, slope, bend = (
        np.append(values, values[0])
        for values in np.fft.ifft(spectrum * (1j * frequency) ** np.array([[0], [1], [2]]))
    )
    curvature = np.abs(np.imag(slope.conj() * bend)) / np.abs(slope) ** 3
    cell = np.minimum(np.sqrt(8 * SAGITTA / np.maximum(curvature, 1e-9)), LONGEST_CELL)

    s = _running(np.abs(np.diff(curve)))
    cells = _running(np.diff(s) * (1 / cell[1:] + 1 / cell[:-1]) / 2)
    node = np.interp(np.linspace(0, cells[-1], math.ceil(cells[-1]) + 1)[:-1], cells, s)
    heading = np.unwrap(np.angle(slope))
    return Track(
        name=name,
        x=np.interp(node, s, np.real(curve)),
        y=np.interp(node, s, np.imag(curve)),
        heading=np.interp(node, s, heading),
        s=node,
        width=np.interp(
            np.interp(node, s, np.append(even, at[-1])), at, np.append(width, width[0])
        ),
        length=float(s[-1]),
        turn=2 * np.pi * round((heading[-1] - heading[0]) / (2 * np.pi)),
    )


def _running(steps):
    """Running sum, from 0."""
    return np.concatenate([[0.0], np.cumsum(steps)])
