"""A bank of tracks as arrays, where a car is on them, and what it can see of them.

The car's cell is part of the state. It moves at most to the neighbouring cell in a physics step,
and all look-ups are of a fixed number of rows around it, so the cost of a step does not depend on
the length of the track, and the other leg of a crossing is never seen.
"""

from collections.abc import Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jaxtyping import Array, Float, Int

from envs.driving.tracks import Track

SIGHT = 200.0  # m


class TrackBank(struct.PyTreeNode):
    """The tracks one after the other, each with its last and first nodes repeated around it."""

    edges: jax.Array  # [rows, 4] m, left x, left y, right x, right y of each node
    line: jax.Array  # [rows, 2] rad and m, heading and s
    first: jax.Array  # [tracks] i32, row of node 0
    count: jax.Array  # [tracks] i32, nodes
    length: jax.Array  # [tracks] m
    friction: jax.Array  # [tracks]
    rolling_resistance: jax.Array  # [tracks]
    reach: int = struct.field(pytree_node=False)
    """The most cells that can be seen through, ahead or behind."""


class Place(NamedTuple):
    """Where a point is on the track."""

    cell: Int[Array, ""]
    crossed: Int[Array, ""]
    """1 where the walk led over the start line forwards, -1 backwards, else 0."""
    s: Float[Array, ""]
    """m along the centre line from the start."""
    heading: Float[Array, ""]
    """rad, of the centre line."""
    position: Float[Array, ""]
    """Across the road: 1 at the left edge, -1 at the right edge; TORCS's trackPos."""
    width: Float[Array, ""]
    """m"""


def make_bank(tracks: Sequence[Track]) -> TrackBank:
    """The bank of these tracks, in this order."""
    reach = max(_reach(track) for track in tracks)
    edges, lines, firsts, rows = [], [], [], 0
    for track in tracks:
        n = len(track.s)
        lap, node = np.divmod(np.arange(-reach, n + reach + 1), n)
        edges.append(np.concatenate([track.left, track.right], -1)[node])
        heading = track.heading[node] + lap * track.turn
        lines.append(np.stack([heading, track.s[node] + lap * track.length], -1))
        firsts.append(rows + reach)
        rows += len(node)
    return TrackBank(
        edges=jnp.asarray(np.concatenate(edges), jnp.float32),
        line=jnp.asarray(np.concatenate(lines), jnp.float32),
        first=jnp.asarray(firsts, jnp.int32),
        count=jnp.asarray([len(track.s) for track in tracks], jnp.int32),
        length=jnp.asarray([track.length for track in tracks], jnp.float32),
        friction=jnp.asarray([track.friction for track in tracks], jnp.float32),
        rolling_resistance=jnp.asarray([track.rolling_resistance for track in tracks], jnp.float32),
        reach=reach,
    )


def _reach(track: Track) -> int:
    """The most cells that a ray can pass within its range, forwards or backwards.

    A ray cannot pass portals (the sides that cells share) that face away from each other, nor more
    of them than lie within its range, at the least distance between neighbours.
    """
    n = len(track.s)
    node = np.arange(2 * n)
    heading = track.heading[node % n] + node // n * track.turn
    forward = np.stack([np.cos(heading), np.sin(heading)], -1)
    ends = np.stack([track.left, track.right], 1)[node % n]  # [2 n, 2, 2]
    step = ends[1:] - ends[:-1]
    onto_last = (step * forward[:-1, None]).sum(-1).min(-1)
    onto_next = (step * forward[1:, None]).sum(-1).min(-1)
    distance = np.concatenate([[0], np.cumsum(np.maximum(np.minimum(onto_last, onto_next), 0))])

    lowest, highest = heading[:n].copy(), heading[:n].copy()
    for reach in range(1, n):
        ahead = np.arange(n) + reach
        lowest = np.minimum(lowest, heading[ahead])
        highest = np.maximum(highest, heading[ahead])
        in_range = distance[ahead] - distance[:n] < SIGHT
        if not (in_range & (highest - lowest < np.pi)).any():
            return reach + 1
    return n


def _along(rows, x, y):
    """m that the point lies ahead of each row's portal."""
    across_x, across_y = rows[:, 0] - rows[:, 2], rows[:, 1] - rows[:, 3]
    ahead = (x - rows[:, 2]) * across_y - (y - rows[:, 3]) * across_x
    return ahead / jnp.sqrt(across_x**2 + across_y**2)


def place(
    bank: TrackBank,
    track: Int[Array, ""] | int,
    cell: Int[Array, ""],
    x: Float[Array, ""],
    y: Float[Array, ""],
) -> Place:
    """Where the point is, walking on from a cell that it was in by at most one cell."""
    row = bank.first[track] + cell
    edges = jax.lax.dynamic_slice(bank.edges, (row - 1, 0), (4, 4))
    ahead = _along(edges, x, y)  # of the portals of this cell and of its neighbours
    step = (ahead[2] >= 0).astype(jnp.int32) - (ahead[1] < 0).astype(jnp.int32)

    def of_step(values):
        return jnp.where(step < 0, values[0], jnp.where(step > 0, values[2], values[1]))

    start, end = of_step(edges[:-1]), of_step(edges[1:])
    past, left_over = of_step(ahead[:-1]), -of_step(ahead[1:])
    share = jnp.clip(past / jnp.maximum(past + left_over, 1e-3), 0.0, 1.0)
    to_right = _left_of(start[2:], end[2:], x, y)
    to_left = -_left_of(start[:2], end[:2], x, y)
    width = jnp.maximum(to_left + to_right, 0.5)

    lines = jax.lax.dynamic_slice(bank.line, (row - 1, 0), (4, 2))
    line_start, line_end = of_step(lines[:-1]), of_step(lines[1:])
    heading, s = line_start + share * (line_end - line_start)
    moved = cell + step
    crossed = (moved >= bank.count[track]).astype(jnp.int32) - (moved < 0).astype(jnp.int32)
    return Place(
        cell=moved - crossed * bank.count[track],
        crossed=crossed,
        s=s - crossed * bank.length[track],
        heading=heading,
        position=(to_right - to_left) / width,
        width=width,
    )


def _left_of(start, end, x, y):
    """m that the point lies to the left of the line from `start` to `end`."""
    along = end - start
    cross = along[0] * (y - start[1]) - along[1] * (x - start[0])
    return cross / jnp.sqrt(along[0] ** 2 + along[1] ** 2)


def point(
    bank: TrackBank, track: Int[Array, ""] | int, s: Float[Array, ""]
) -> tuple[Int[Array, ""], Float[Array, ""], Float[Array, ""], Float[Array, ""]]:
    """The cell, x m, y m and heading rad of the centre line at s."""
    cell = _cell_at(bank, track, s)
    first = bank.first[track]
    line = jax.lax.dynamic_slice(bank.line, (first + cell, 0), (2, 2))
    edges = jax.lax.dynamic_slice(bank.edges, (first + cell, 0), (2, 4))
    share = (s - line[0, 1]) / (line[1, 1] - line[0, 1])
    left_x, left_y, right_x, right_y = edges[0] + share * (edges[1] - edges[0])
    heading = line[0, 0] + share * (line[1, 0] - line[0, 0])
    return cell, (left_x + right_x) / 2, (left_y + right_y) / 2, heading


def curvature(
    bank: TrackBank, track: Int[Array, ""] | int, s: Float[Array, ""]
) -> Float[Array, ""]:
    """1/m of the centre line at s, which may lie laps ahead; to the left is positive."""
    cell = _cell_at(bank, track, s % bank.length[track])
    line = jax.lax.dynamic_slice(bank.line, (bank.first[track] + cell, 0), (2, 2))
    return (line[1, 0] - line[0, 0]) / (line[1, 1] - line[0, 1])


def _cell_at(bank: TrackBank, track, s):
    """The cell of the centre line at s of one lap, by bisection."""
    first = bank.first[track]

    def halve(_, bounds):
        low, high = bounds
        middle = (low + high) // 2
        before = bank.line[first + middle, 1] <= s
        return jnp.where(before, middle, low), jnp.where(before, high, middle)

    bounds = (jnp.zeros_like(first), bank.count[track])
    halvings = int(bank.line.shape[0]).bit_length()
    return jax.lax.fori_loop(0, halvings, halve, bounds)[0]
