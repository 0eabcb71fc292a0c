"""Tracks from points along a lap, as in the TUMFTM race track database."""

from pathlib import Path

import numpy as np
from jaxtyping import Float
from scipy.interpolate import splev, splprep

from envs.driving.tracks import LONGEST_CELL, SAGITTA, Track

CSV_COLUMNS = ("x_m", "y_m", "w_tr_right_m", "w_tr_left_m")
LARGEST_STEP_BACK = 3.0  # from the last point of a CSV to its first, of its longest step
SMOOTHING = 0.1  # m, how far the curve may leave the points of a CSV, root mean square


def read_csv(path: Path) -> Track:
    """The track of a TUMFTM file: x_m, y_m, w_tr_right_m, w_tr_left_m of points along a lap.

    The middle between the edges is smoothed by a periodic cubic spline; the start is its first
    point.
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
    return points


def from_points(
    name: str, middle: Float[np.ndarray, "n 2"], width: Float[np.ndarray, "n"]
) -> Track:
    """The track along a smooth curve near these points, m, the first one not repeated."""
    loop = np.concatenate([middle, middle[:1]])
    (tck, at) = splprep(loop.T, s=len(middle) * SMOOTHING**2, per=True)
    fine = np.linspace(0, 1, 40 * len(middle) + 1)
    dx, dy = np.array(splev(fine, tck, 1))
    ddx, ddy = np.array(splev(fine, tck, 2))
    speed = np.hypot(dx, dy)
    curvature = np.abs(dx * ddy - dy * ddx) / speed**3
    s = _integral(speed, fine)
    cell = np.minimum(np.sqrt(8 * SAGITTA / np.maximum(curvature, 1e-9)), LONGEST_CELL)
    cells = _integral(speed / cell, fine)
    nodes = np.interp(np.linspace(0, cells[-1], int(np.ceil(cells[-1])) + 1)[:-1], cells, fine)

    x, y = np.array(splev(nodes, tck))
    heading = np.unwrap(np.arctan2(dy, dx))
    turn = 2 * np.pi * round((heading[-1] - heading[0]) / (2 * np.pi))
    return Track(
        name=name,
        x=x,
        y=y,
        heading=np.interp(nodes, fine, heading),
        s=np.interp(nodes, fine, s),
        width=np.interp(nodes, at, np.append(width, width[0])),
        length=float(s[-1]),
        turn=turn,
    )


def _integral(values, at):
    """Running integral by the trapezium rule, from 0."""
    steps = np.diff(at) * (values[1:] + values[:-1]) / 2
    return np.concatenate([[0.0], np.cumsum(steps)])
