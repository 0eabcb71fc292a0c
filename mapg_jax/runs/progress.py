"""How far a run is: a bar on a terminal, a line an evaluation elsewhere; on standard error."""

import sys

import rich.console
import rich.progress

from mapg_jax.runs.metrics import Row


class Progress:
    """A bar on a terminal, a line an evaluation elsewhere; both on standard error."""

    def __init__(self, total_steps: int, enabled: bool = True):
        console = rich.console.Console(stderr=True)
        self._lines = enabled and not console.is_terminal
        self._total = total_steps
        self._bar = rich.progress.Progress(
            rich.progress.BarColumn(bar_width=None),
            rich.progress.MofNCompleteColumn(),
            rich.progress.TextColumn("{task.fields[episode_return]}"),
            rich.progress.TextColumn("{task.fields[rate]} steps/s"),
            rich.progress.TimeRemainingColumn(elapsed_when_finished=True),
            console=console,
            disable=not enabled or self._lines,
        )
        self._task = self._bar.add_task(
            "", total=total_steps, episode_return="not yet evaluated", rate="-"
        )

    def __enter__(self) -> "Progress":
        self._bar.start()
        return self

    def __exit__(self, *_) -> None:
        self._bar.stop()

    def advance(self, env_steps: int, steps_per_second: float) -> None:
        """Moves the bar."""
        self._bar.update(self._task, completed=env_steps, rate=f"{steps_per_second:,.0f}")

    def learning(self) -> None:
        """Says that the first updates are made: everything is compiled."""
        if self._lines:
            print("learning", file=sys.stderr, flush=True)

    def evaluated(self, row: Row, seconds_left: float) -> None:
        """Shows an evaluation's return."""
        text = f"{row['return_mean']:.1f} ± {row['return_std']:.1f}"
        self._bar.update(self._task, episode_return=f"return {text}")
        if self._lines:
            print(
                f"step {int(row['env_steps']):,} of {self._total:,}: return {text}, "
                f"{row['steps_per_second']:,.0f} steps/s, {seconds_left:,.0f} s left",
                file=sys.stderr,
                flush=True,
            )
