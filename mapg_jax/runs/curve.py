"""The picture of a run: how its return rose."""

import pathlib

from mapg_jax.runs.metrics import read_metrics


def draw_curve(metrics: pathlib.Path, path: pathlib.Path, title: str) -> None:
    """Return and spread of the actions (of A3C its σ) over environment steps, as a PNG."""
    from matplotlib.figure import Figure

    rows = read_metrics(metrics)
    steps = [row["env_steps"] for row in rows]
    figure = Figure(figsize=(7, 4.5), layout="constrained")
    upper, lower = figure.subplots(2, sharex=True, height_ratios=(2, 1))
    mean = [row["return_mean"] for row in rows]
    low = [row["return_mean"] - row["return_std"] for row in rows]
    high = [row["return_mean"] + row["return_std"] for row in rows]
    upper.plot(steps, mean, marker=".", color="tab:blue")
    upper.fill_between(steps, low, high, alpha=0.2, color="tab:blue", linewidth=0)
    episodes = int(rows[0]["episodes"])
    upper.set(title=title, ylabel=f"return\nmean ± std of {episodes} episodes")
    column, label = "spread", "spread of\nthe actions"
    if "action_std" in rows[0]:
        column, label = "action_std", "σ of\nthe actions"
    lower.plot(steps, [row[column] for row in rows], marker=".", color="tab:orange")
    lower.set(xlabel="environment steps", ylabel=label)
    lower.set_ylim(bottom=0)
    figure.savefig(path, dpi=120)
