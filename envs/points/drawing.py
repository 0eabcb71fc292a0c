"""Pictures of paths through a plane: over the critic's values as a PNG, and moving as HTML."""

import base64
import io
import json
from collections.abc import Sequence
from pathlib import Path
from string import Template
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Float32

from envs.maps import HEADS, draw_map, grid, light_greys
from envs.recording import Episode, Player

PLAYER = Path(__file__).with_name("player.html")
ACROSS = 121  # points of the critic's picture, each way
ARROWS = 8  # states whose proposals are drawn, each way; in a maze, one in every cell


class Plane(NamedTuple):
    """What lies below the paths: a rectangle and its goals, perhaps with walls."""

    title: str
    low: Float[np.ndarray, "2"]  # the corners
    high: Float[np.ndarray, "2"]
    goals: Float[np.ndarray, "G 2"]
    radius: float  # of a goal
    walls: Float[np.ndarray, "W 2"] = np.zeros((0, 2))  # centres of square walls
    wall_size: float = 0.0
    step: float = 1.0  # what an action of 1 moves
    unit: str = ""

    @property
    def extent(self) -> tuple[float, ...]:
        """As Matplotlib wants it."""
        return self.low[0], self.high[0], self.low[1], self.high[1]

    def inside(self, places: Float[np.ndarray, "*N 2"]) -> Bool[np.ndarray, "*N"]:
        """Whether places are free of walls."""
        off = np.abs(places[..., None, :] - self.walls).max(-1)
        return (off > self.wall_size / 2).all(-1)


def draw(plane: Plane, episodes: Sequence[Episode], player: Player, path: Path) -> None:
    """Left: paths, values and proposals over the plane. Right: Q of all actions at the start."""
    from matplotlib.figure import Figure  # slow to import, and needed once a run

    figure = Figure(figsize=(13, 5.6), layout="constrained")
    left, right = figure.subplots(1, 2)
    _draw_paths(figure, left, plane, episodes, player)
    _draw_actions(figure, right, episodes[0].observations[0], player)
    figure.savefig(path, dpi=120)


def animate(plane: Plane, episodes: Sequence[Episode], player: Player, path: Path) -> None:
    """The episodes as an animation in one HTML file, which a browser opens without a network."""
    page = {
        "title": plane.title,
        "low": plane.low.tolist(),
        "high": plane.high.tolist(),
        "step": plane.step,
        "unit": plane.unit,
        "goals": plane.goals.tolist(),
        "radius": plane.radius,
        "walls": plane.walls.tolist(),
        "wall_size": plane.wall_size,
        "values": _as_image(_values(plane, player)),
        "paths": [e.observations.astype(float).round(3).tolist() for e in episodes],
        "proposals": [
            player.proposals(e.observations)[0].astype(float).round(2).tolist() for e in episodes
        ],
    }
    # "</" would end the script.
    data = json.dumps(page, separators=(",", ":")).replace("</", "<\\/")
    path.write_text(Template(PLAYER.read_text("utf-8")).substitute(page=data), encoding="utf-8")


def _draw_paths(figure, axes, plane: Plane, episodes: Sequence[Episode], player: Player) -> None:
    from matplotlib.patches import Circle, Rectangle

    label = "mean Q of the proposals"
    draw_map(figure, axes, _values(plane, player), plane.extent, label)
    corner, size = plane.wall_size / 2, plane.wall_size
    for wall in plane.walls:
        axes.add_patch(Rectangle(wall - corner, size, size, color="0.25", linewidth=0))
    _draw_proposals(axes, plane, player)
    for episode in episodes:
        axes.plot(*episode.observations.T, color="black", linewidth=1.2, alpha=0.7)
    ends = np.stack([episode.observations[-1] for episode in episodes])
    axes.plot(*ends.T, "o", color="white", markeredgecolor="black", markersize=5)
    for number, goal in enumerate(plane.goals, 1):
        axes.add_patch(Circle(goal, plane.radius, fill=False, color="tab:red", linewidth=2))
        style = {"color": "tab:red", "weight": "bold", "textcoords": "offset points"}
        axes.annotate(str(number), goal, (8, 8), **style)
    axes.set(title=f"{plane.title}: {len(episodes)} episodes", xlabel=f"x{plane.unit}")
    axes.set(ylabel=f"y{plane.unit}", xlim=plane.extent[:2], ylim=plane.extent[2:])


def _draw_proposals(axes, plane: Plane, player: Player) -> None:
    """What every head would do, at a few places."""
    wide = (plane.high - plane.low).max()
    across = round(wide / plane.wall_size) if len(plane.walls) else ARROWS
    apart = (plane.high - plane.low) / across
    places = grid(plane.low + apart / 2, plane.high - apart / 2, across).reshape(-1, 2)
    places = places[plane.inside(places)]
    actions, _ = player.proposals(places)
    heads = actions.shape[1]
    axes.quiver(
        *np.repeat(places, heads, 0).T,
        *actions.reshape(-1, 2).T * 0.45 * apart.min(),  # so that neighbours do not touch
        np.tile(np.arange(heads), len(places)),
        cmap=HEADS,
        angles="xy",
        scale_units="xy",
        scale=1,
        width=0.003,
    )


def _draw_actions(figure, axes, observation: Float32[np.ndarray, "2"], player: Player) -> None:
    actions = grid(-np.ones(2), np.ones(2), ACROSS)
    values = player.q_values(observation[None], actions.reshape(1, -1, 2)).reshape(ACROSS, ACROSS)
    draw_map(figure, axes, values, (-1.0, 1.0, -1.0, 1.0), "Q")
    proposals, _ = player.proposals(observation[None])
    heads = proposals.shape[1]
    axes.scatter(
        *proposals[0].T, c=np.arange(heads), cmap=HEADS, s=60, edgecolors="black", zorder=3
    )
    axes.set(title=f"actions at the start, {heads} proposed")
    axes.set(xlabel="action, x", ylabel="action, y", xlim=(-1.05, 1.05), ylim=(-1.05, 1.05))


def _values(plane: Plane, player: Player) -> Float[np.ndarray, "Y X"]:
    """The mean over the heads of the critic's values of their proposals; nan inside a wall."""
    places = grid(plane.low, plane.high, ACROSS)
    _, values = player.proposals(places.reshape(-1, 2))
    return np.where(plane.inside(places), values.mean(-1).reshape(ACROSS, ACROSS), np.nan)


def _as_image(values: Float[np.ndarray, "Y X"]) -> str:
    """A picture as a data address."""
    from matplotlib.image import imsave

    file = io.BytesIO()
    imsave(file, values, origin="lower", cmap=light_greys(), format="png")
    return "data:image/png;base64," + base64.b64encode(file.getvalue()).decode()
