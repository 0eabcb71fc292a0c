"""Pictures of the page, and beside each of them the numbers that it shows."""

from typing import TYPE_CHECKING

import numpy as np

from experiments.plan import Plan
from mapg_jax.runs import csv_file

if TYPE_CHECKING:  # slow to import
    from matplotlib.figure import Figure

FOLDER = "plotted"
HEADER = ("panel", "line", "x", "y")


def save(plan: Plan, figure: "Figure", name: str) -> str:
    """Writes NAME.png and plotted/NAME.csv; gives the first one's file name."""
    file = f"{name}.png"
    figure.savefig(plan.results / file, dpi=120)
    (plan.results / FOLDER).mkdir(exist_ok=True)
    csv_file.write(plan.results / FOLDER / f"{name}.csv", HEADER, plotted(figure))
    return file


def plotted(figure: "Figure") -> list[list[str]]:
    """All points of all lines, boxes among them, and the tops of all bars, to five digits: a
    picture's bytes differ between machines, and these do not."""
    points = []
    for panel, axes in enumerate(figure.axes):
        drawn = [np.asarray(line.get_xydata()) for line in axes.lines]
        drawn += [
            np.array([(bar.get_x(), bar.get_y() + bar.get_height()) for bar in bars])
            for bars in axes.containers
        ]
        points += [
            [str(panel), str(line), f"{x:.5g}", f"{y:.5g}"]
            for line, xy in enumerate(drawn)
            for x, y in xy
        ]
    return points
