"""Pictures of several runs together."""

from collections.abc import Collection, Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np

from mapg_jax.reports import inference as statistics

if TYPE_CHECKING:  # slow to import, and needed once a run
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

Curve = Mapping[str, np.ndarray]
"""`env_steps` and other columns of metrics.csv."""
COLOURS = ("#000000", "#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9")
"""Okabe and Ito's, which the colour-blind tell apart too."""
STYLES = ("-", "--", ":")
"""Of lines, from the eighth on, when the colours come round again."""
DASHES = ("-", "--", ":", "-", "-.", (0, (5, 1, 1, 1, 1, 1)))
"""Of lines that cross often: colours that are near each other have other dashes."""
TOGETHER = "together"
"""Names the line of all tasks in a forest plot."""
PANEL = (4.3, 3.2)  # inches
LEAST_IN_A_BOX = 5


def draw_curves(
    tasks: Mapping[str, Mapping[str, Sequence[Curve]]],
    column: str = "return_mean",
    label: str = "return of an evaluation",
) -> "Figure":
    """A panel a task, a line an arm: the mean over its seeds, and the 95 % interval as a band.

    n, the number of seeds, stands in the legend, from the least to the most of all panels.

    Args:
      tasks: by task and arm, the curve of every seed. An arm has one colour in all panels.
      column: of the curves, what is drawn over environment steps.
      label: of that axis, with its unit.
    """
    from matplotlib.ticker import EngFormatter

    figure, panels = _panels(tasks, "environment steps", label)
    arms = list(dict.fromkeys(arm for of_task in tasks.values() for arm in of_task))
    for place, arm in enumerate(arms):
        colour = COLOURS[place % len(COLOURS)]
        style = STYLES[place // len(COLOURS) % len(STYLES)]
        seeds = sorted({len(of_task[arm]) for of_task in tasks.values() if arm in of_task})
        several = f"{seeds[0]} to {seeds[-1]}" if len(seeds) > 1 else seeds[0]
        panels[0].plot([], [], label=f"{arm} (n = {several})", color=colour, linestyle=style)
        for axes, of_task in zip(panels, tasks.values(), strict=True):
            if arm in of_task:
                steps, mean, low, high = mean_curve(of_task[arm], column)
                axes.plot(steps, mean, linewidth=1.5, color=colour, linestyle=style)
                axes.fill_between(steps, low, high, alpha=0.12, linewidth=0, color=colour)
                for edge in (low, high):  # tells overlapping bands apart
                    axes.plot(steps, edge, linewidth=0.6, color=colour, linestyle=style)
    for axes in panels:
        axes.xaxis.set_major_formatter(EngFormatter(sep=""))
    _legend_below(figure, panels[0])
    return figure


def _legend_below(figure: "Figure", axes: "Axes") -> None:
    """As many columns as fit the figure, which would cut off what is wider."""
    handles, labels = axes.get_legend_handles_labels()
    widest = 0.7 + 0.09 * max(map(len, labels))  # inches, of the line, its space and 10 pt letters
    columns = max(1, int(figure.get_figwidth() / widest))
    figure.legend(handles, labels, loc="outside lower center", ncols=min(columns, 4), frameon=False)


def mean_curve(
    curves: Sequence[Curve], column: str
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Environment steps, and the mean over seeds with its 95 % bootstrap interval at each.

    The steps are those of the curve with the fewest rows, as far as all curves go; the others are
    interpolated linearly where they were evaluated at other steps.

    Returns:
      steps, mean, low, high: [T], nan where there is none.
    """
    last = min(curve["env_steps"][-1] for curve in curves)
    first = max(curve["env_steps"][0] for curve in curves)
    steps = min((curve["env_steps"] for curve in curves), key=len)
    steps = steps[(steps >= first) & (steps <= last)]
    values = [np.interp(steps, curve["env_steps"], curve[column]) for curve in curves]
    band = np.full((3, len(steps)), np.nan)
    for point, of_seeds in enumerate(np.transpose(values)):
        if np.isfinite(of_seeds).all():
            band[:, point] = statistics.mean(of_seeds)
    return steps, band[0], band[1], band[2]


def draw_boxes(
    tasks: Mapping[str, Mapping[str, Sequence[Sequence[float] | np.ndarray]]],
    label: str = "score: mean return of a run",
) -> "Figure":
    """A panel a task, a place an arm, and a dot a seed; from five numbers on a box.

    A box has quartiles and median, whiskers to 1.5 times its height, and a speck for each number
    beyond.

    Args:
      tasks: by task and arm, the numbers of every seed: its score alone, or the return of each of
        its episodes. A box is of all numbers together, a dot the mean of one seed's.
      label: of the vertical axis, with its unit.
    """
    figure, panels = _panels(tasks, "M, actions proposed per state", label)
    for axes, of_task in zip(panels, tasks.values(), strict=True):
        for place, seeds in enumerate(of_task.values()):
            numbers = np.concatenate([np.atleast_1d(x) for x in (*seeds, [])])
            if len(numbers) >= LEAST_IN_A_BOX:
                axes.boxplot(
                    numbers,
                    positions=[place],
                    widths=0.6,
                    flierprops={"marker": ".", "markersize": 2},
                    medianprops={"color": COLOURS[2], "linewidth": 2},
                )
            aside = 0.3 * (np.arange(len(seeds)) - (len(seeds) - 1) / 2) / max(1, len(seeds))
            means = [np.mean(x) for x in seeds]
            axes.plot(place + aside, means, "o", color=COLOURS[1], alpha=0.7, markersize=5)
        counts = [f"n = {len(seeds)}" if seeds else "missing" for seeds in of_task.values()]
        names = [f"{arm}\n{count}" for arm, count in zip(of_task, counts, strict=True)]
        axes.set_xticks(range(len(names)), names)
        axes.set_xlim(-0.6, len(names) - 0.4)
    return figure


def draw_forest(
    groups: Mapping[str, Mapping[str, statistics.Estimate]], label: str, null: float = 0.5
) -> "Figure":
    """A panel a comparison, a line a task: estimate and interval; hollow where there is none.

    Args:
      groups: by comparison and task; what is of the tasks TOGETHER is drawn as a diamond.
      label: of the horizontal axis.
      null: where there is no difference.
    """
    from matplotlib.figure import Figure

    lines = [len(of) for of in groups.values()]
    figure = Figure(figsize=(7, 0.9 + 0.3 * sum(lines) + 0.4 * len(lines)), layout="constrained")
    panels = figure.subplots(len(lines), 1, sharex=True, squeeze=False, height_ratios=lines)[:, 0]
    for axes, (title, estimates) in zip(panels, groups.items(), strict=True):
        for place, (name, estimate) in enumerate(estimates.items()):
            colour, marker = (COLOURS[2], "D") if name == TOGETHER else (COLOURS[1], "o")
            axes.plot([estimate.low, estimate.high], [place, place], color=colour, linewidth=1.5)
            filled = "full" if np.isfinite(estimate.low) else "none"
            axes.plot(estimate.value, place, marker, color=colour, markersize=6, fillstyle=filled)
        axes.set_yticks(range(len(estimates)), list(estimates))
        axes.set_ylim(len(estimates) - 0.5, -0.5)
        axes.axvline(null, color="0.4", linestyle="--", linewidth=1)
        axes.set_title(title, loc="left", fontsize=10)
        axes.spines[["top", "right"]].set_visible(False)
    panels[-1].set(xlim=(-0.02, 1.02), xlabel=label)
    return figure


def draw_profiles(
    tasks: Mapping[str, Mapping[str, Sequence[float]]], label: str = "share of runs above"
) -> "Figure":
    """A panel a task, a line an arm: the share of its runs that score above x.

    Args:
      tasks: by task and arm, the score of every seed. An arm has one colour in all panels.
      label: of the vertical axis.
    """
    figure, panels = _panels(tasks, "score, x", label)
    arms = list(dict.fromkeys(arm for of_task in tasks.values() for arm in of_task))
    for axes, of_task in zip(panels, tasks.values(), strict=True):
        for arm, values in of_task.items():
            place = arms.index(arm)
            x, y = profile(values)
            style = DASHES[place % len(DASHES)]
            axes.step(x, y, where="post", color=COLOURS[place % len(COLOURS)], linestyle=style,
                      label=f"{arm} (n = {len(values)})")  # fmt: skip
        axes.set_ylim(-0.03, 1.03)
        axes.legend(frameon=False, fontsize=7)
    return figure


def profile(values: Sequence[float]) -> tuple[np.ndarray, np.ndarray]:
    """Corners of the share of values above x: 1 before the least, 0 from the largest on."""
    x = np.sort(np.asarray(values, float))
    margin = 0.03 * (np.ptp(x) or abs(x[0]) or 1.0)
    share = 1 - np.arange(1, len(x) + 1) / len(x)
    return np.array([x[0] - margin, *x, x[-1] + margin]), np.array([1.0, *share, 0.0])


def _panels(titles: Collection[str], below: str, beside: str) -> "tuple[Figure, list[Axes]]":
    """A figure with a titled panel each, two side by side: legible at a page's width."""
    from matplotlib.figure import Figure

    if not titles:
        raise ValueError("there is nothing to draw")
    columns = min(2, len(titles))
    rows = -(-len(titles) // columns)
    width, height = PANEL if columns > 1 else (7, 4)
    figure = Figure(figsize=(columns * width, rows * height), layout="constrained")
    panels = list(figure.subplots(rows, columns, squeeze=False).ravel())
    for axes in panels[len(titles) :]:
        axes.remove()
    for place, (axes, title) in enumerate(zip(panels, titles, strict=False)):
        axes.set_title(title)
        axes.grid(axis="y", alpha=0.3, linewidth=0.5)
        axes.spines[["top", "right"]].set_visible(False)
        if place % columns == 0:
            axes.set_ylabel(beside)
        if place + columns >= len(titles):
            axes.set_xlabel(below)
    return figure, panels[: len(titles)]


def draw_shares(
    arms: Mapping[str, Mapping[str, Sequence[float]]], across: str, up: str, part: str
) -> "Figure":
    """A panel an arm, a bar a run, stacked of its shares.

    Args:
      arms: by arm and run, the shares of its parts, which add up to 1 at most.
      across: what the runs are.
      up: what the bars are of.
      part: what a share is the share of; numbered from 1.
    """
    from matplotlib.figure import Figure

    figure = Figure(figsize=(1 + 3 * len(arms), 3.2), layout="constrained")
    panels = figure.subplots(1, len(arms), sharey=True, squeeze=False)[0]
    for axes, (arm, by_run) in zip(panels, arms.items(), strict=True):
        shares = np.array(list(by_run.values()), float)
        below = np.cumsum(shares, 1) - shares
        for k, (share, start) in enumerate(zip(shares.T, below.T, strict=True)):
            axes.bar(list(by_run), share, bottom=start, color=COLOURS[k], label=f"{part} {k + 1}")
        axes.set(title=f"{arm} (n = {len(by_run)})", xlabel=across, ylim=(0, 1))
        axes.tick_params(axis="x", rotation=90)
    panels[0].set_ylabel(up)
    panels[-1].legend(frameon=False, loc="center left", bbox_to_anchor=(1, 0.5))
    return figure
