"""Point maze: a point in the mazes of DDiffPG's AntMaze, with several ways or several goals."""

import jax
import jax.numpy as jnp
import numpy as np

from envs.points.drawing import Plane
from envs.points.point import Point
from envs.scored import reached

CELL = 4.0  # m, side of a cell
STEP = 1.0  # m, what an action of 1 moves
START_RANGE = 0.1  # m
RADIUS, GOAL_REWARD = 0.5, 10.0  # m, -
MAZES = {
    "v1": ("11111", "10001", "1G1R1", "10001", "11111"),
    "v2": (
        "111111111",
        "1111G1111",
        "111101111",
        "111101111",
        "1G00R00G1",
        "111101111",
        "111101111",
        "1111G1111",
        "111111111",
    ),
}
"""Seen from above: 1 is wall, 0 free, R the start, G a goal. Of v2 the goals' places are
published; the walls between them are ours."""


class PointMaze(Point):
    """A point in a maze of AntMaze (DDiffPG), in place of the ant.

    action       [2] displacement; ±1 is ±1 m. An axis along which the step would end in a wall
                 stands still: x first, then y
    observation  [2] place (m); the start's cell is centred at 0
    reward       10 at a goal, else 0
    start        uniform within ±0.1 m of the centre of the start's cell
    end          nearer than 0.5 m to a goal

    The goals are numbered from 1 on, row by row from above.

    Args:
      maze: "v1", one goal at (-8, 0) m and two ways to it, or "v2", four goals at (0, ±12) and
        (±12, 0) m.
    """

    drawn_episodes = 10
    scored_metrics = reached(
        "goal", "goals", max("".join(maze).count("G") for maze in MAZES.values())
    )
    radius = RADIUS

    def __init__(self, maze: str = "v1"):
        if maze not in MAZES:
            raise ValueError(f"unknown maze {maze!r}; known are {', '.join(MAZES)}")
        cells = np.array([list(row) for row in MAZES[maze]])
        (self._row, self._column) = (int(i) for i in np.argwhere(cells == "R")[0])
        self.goals = self._centres(np.argwhere(cells == "G")).astype(np.float32)
        self.scored_metrics = reached("goal", "goals", len(self.goals))
        self._walls = cells == "1"
        corners = self._centres(np.array([[len(cells) - 1, 0], [0, len(cells[0]) - 1]]))
        self.plane = Plane(
            title=f"point_maze {maze}",
            low=corners[0] - CELL / 2,
            high=corners[1] + CELL / 2,
            goals=self.goals,
            radius=RADIUS,
            walls=self._centres(np.argwhere(self._walls)),
            wall_size=CELL,
            step=STEP,
            unit=", m",
        )

    def start(self, rng):
        return jax.random.uniform(rng, (2,), minval=-START_RANGE, maxval=START_RANGE)

    def move(self, place, action):
        x, y = place
        to_x, to_y = place + STEP * action
        x = jnp.where(self._in_wall(to_x, y), x, to_x)
        return jnp.stack([x, jnp.where(self._in_wall(x, to_y), y, to_y)])

    def payoff(self, place, action, goal):
        return jnp.where(goal > 0, GOAL_REWARD, 0.0)

    def _in_wall(self, x, y):
        row = jnp.floor(self._row + 0.5 - y / CELL).astype(jnp.int32)
        column = jnp.floor(self._column + 0.5 + x / CELL).astype(jnp.int32)
        return jnp.asarray(self._walls)[row, column]

    def _centres(self, cells: np.ndarray) -> np.ndarray:
        """Places (m) of the middles of cells, given by row and column."""
        return CELL * np.stack([cells[:, 1] - self._column, self._row - cells[:, 0]], -1)
