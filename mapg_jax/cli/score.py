"""A score as a table."""

from typing import Any, TextIO

from mapg_jax.cli.console import console


def print_score(record: dict[str, Any], out: TextIO) -> None:
    """One line, and the means of what else the environment counts."""
    import rich.table  # slow to import

    scored = record.get("metrics", {})
    titles = ("env", "physics", "select", "episodes", "mean", "std", "95 % interval")
    table = rich.table.Table(*titles, *(f"mean {name}" for name in scored))
    low, high = record["ci95"]
    table.add_row(
        record["env"],
        record["physics"],
        record["select"],
        str(record["episodes"]),
        f"{record['mean']:.1f}",
        f"{record['std']:.1f}",
        f"{low:.1f} to {high:.1f}",
        *(f"{sum(values) / len(values):.1f}" for values in scored.values()),
    )
    console(out).print(table)
