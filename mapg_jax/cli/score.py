"""A score as a table."""

from typing import Any, TextIO

from mapg_jax.cli.console import console


def print_score(record: dict[str, Any], out: TextIO) -> None:
    """A line, and what else the environment counts."""
    import rich.table  # slow to import

    titles = ("env", "physics", "select", "episodes", "mean", "std", "95 % interval")
    table = rich.table.Table(*titles)
    low, high = record["ci95"]
    table.add_row(
        record["env"],
        record["physics"],
        record["select"],
        str(record["episodes"]),
        f"{record['mean']:.1f}",
        f"{record['std']:.1f}",
        f"{low:.1f} to {high:.1f}",
    )
    console(out).print(table)
    for name, number in record.get("scored", {}).items():
        print(f"{name}: {number:.4g}", file=out)
