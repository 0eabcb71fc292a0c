"""Pictures of bandits: what all actions are worth, to the task and to the critic."""

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, Float32

from envs.frames import Canvas, Painter, Picture
from envs.maps import HEADS, draw_map, grid
from envs.recording import Episode, Player

ACROSS = 201  # points of an axis
LEVELS = 12  # of grey, in videos
FLOOR = 3.0  # below the best action, in rewards: what is worse looks all the same

Reward = Callable[[Float32[np.ndarray, "*N A"]], Float[np.ndarray, "*N"]]


def draw_line(
    title: str,
    reward: Reward,
    optima: Float[np.ndarray, "K 1"],
    episodes: Sequence[Episode],
    player: Player,
    path: Path,
) -> None:
    """Actions of one number: reward and Q as lines; proposals and executed actions below them."""
    from matplotlib.figure import Figure  # slow to import, and needed once a run

    start, proposals, executed = _of(episodes, player)
    actions = np.linspace(-1, 1, ACROSS, dtype=np.float32)[:, None]
    figure = Figure(figsize=(8, 5), layout="constrained")
    upper, lower = figure.subplots(2, sharex=True, height_ratios=(4, 1))
    upper.plot(actions, reward(actions), color="tab:red", label="reward")
    q = player.q_values(start[None], actions[None])[0]
    upper.plot(actions, q, color="0.3", label="Q, of the critic")
    values = player.q_values(start[None], proposals[None])[0]
    style = {"c": np.arange(len(proposals)), "cmap": HEADS, "edgecolors": "black", "zorder": 3}
    upper.scatter(proposals[:, 0], values, s=60, label=f"{len(proposals)} proposals", **style)
    for optimum in optima[:, 0]:
        upper.axvline(optimum, color="tab:red", linestyle=":", linewidth=1)
        lower.axvline(optimum, color="tab:red", linestyle=":", linewidth=1)
    upper.set(title=f"{title}; dotted: its optima", ylabel="reward")
    upper.legend(frameon=False)
    lower.hist(executed[:, 0], bins=80, range=(-1, 1), color="0.3")
    lower.set(xlabel="action", ylabel=f"of {len(episodes)}\nepisodes", xlim=(-1.03, 1.03))
    figure.savefig(path, dpi=120)


def draw_plane(
    title: str,
    reward: Reward,
    optima: Float[np.ndarray, "K 2"],
    episodes: Sequence[Episode],
    player: Player,
    path: Path,
) -> None:
    """Actions of two numbers: reward and Q as maps, with proposals and executed actions."""
    from matplotlib.figure import Figure

    start, proposals, executed = _of(episodes, player)
    actions = grid(-np.ones(2), np.ones(2), ACROSS)
    q = player.q_values(start[None], actions.reshape(1, -1, 2)).reshape(ACROSS, ACROSS)
    figure = Figure(figsize=(13, 5.6), layout="constrained")
    for axes, label, values in zip(
        figure.subplots(1, 2), ("reward", "Q, of the critic"), (reward(actions), q), strict=True
    ):
        values = np.maximum(values, np.max(values) - FLOOR)
        draw_map(figure, axes, values, (-1, 1, -1, 1), f"{label}, {FLOOR:g} below the best and up")
        axes.plot(*optima.T, "*", color="tab:red", markersize=15, label="optima")
        axes.plot(*executed.T, "x", color="black", label=f"actions of {len(episodes)} episodes")
        colours = np.arange(len(proposals))
        axes.scatter(
            *proposals.T,
            s=50,
            c=colours,
            cmap=HEADS,
            edgecolors="black",
            zorder=3,
            label=f"{len(proposals)} proposals",
        )
        axes.set(title=f"{title}: {label}", xlabel="action, x", ylabel="action, y")
        axes.set(xlim=(-1.03, 1.03), ylim=(-1.03, 1.03))
        axes.legend(loc="lower left")
    figure.savefig(path, dpi=120)


def paint_line(
    reward: Reward, optima: Float[np.ndarray, "K 1"], width: int, height: int
) -> Painter:
    """States of one number as a disc on the line of rewards, whose optima are green."""
    across = np.linspace(-1, 1, ACROSS, dtype=np.float32)
    worth = np.asarray(reward(across[:, None]))
    raised = (worth - worth.min()) / np.ptp(worth)

    def at(x: Any) -> tuple[float, float]:
        return float(x), float(np.interp(x, across, raised))

    def paint(place: Any) -> Picture:
        canvas = Canvas((-1.1, -0.6), (1.1, 1.6), width, height)
        canvas.line(np.column_stack([across, raised]), "#777777", 0.02)
        for optimum in optima[:, 0]:
            canvas.disc(at(optimum), 0.06, "#7ec29b")
        canvas.disc(at(place[0]), 0.04, "#b3402a")
        return canvas.picture()

    return paint


def paint_plane(
    optima: Float[np.ndarray, "K 2"],
    heights: Float[np.ndarray, "K"],
    widths: Float[np.ndarray, "K"],
    width: int,
    height: int,
) -> Painter:
    """States of two numbers as a disc over the rewards; what is worth a level is discs, too."""
    levels = np.linspace(heights.max() - FLOOR, heights.max(), LEVELS, endpoint=False)

    def paint(place: Any) -> Picture:
        canvas = Canvas((-1.1, -1.1), (1.1, 1.1), width, height)
        for grey, level in zip(np.linspace(0xF0, 0x80, LEVELS), levels, strict=True):
            for optimum, most, sigma in zip(optima, heights, widths, strict=True):
                if most > level:
                    radius = sigma * np.sqrt(2 * (most - level))
                    canvas.disc(optimum, radius, "#" + f"{round(grey):02x}" * 3)
        for optimum in optima:
            canvas.disc(optimum, 0.02, "#7ec29b")
        canvas.disc(np.asarray(place), 0.03, "#b3402a")
        return canvas.picture()

    return paint


def _of(episodes: Sequence[Episode], player: Player) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The start, its proposals [M, A] and the executed actions [E, A]."""
    start = episodes[0].observations[0]
    return start, player.proposals(start[None])[0][0], np.concatenate([e.actions for e in episodes])
