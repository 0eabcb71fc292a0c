"""What the host keeps of one run: its folder, its checkpoints, and the rows of its metrics."""

import logging
import math
import pathlib
import shutil
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from mapg_jax.runs import hosts
from mapg_jax.runs.checkpoints import Checkpoints, DamagedError
from mapg_jax.runs.folder import RunFolder
from mapg_jax.runs.metrics import MetricsFile, cut_metrics, rows_digest
from mapg_jax.training import replay
from mapg_jax.training.config import ReplayConfig
from mapg_jax.training.evaluation import Played, summarize
from mapg_jax.training.state import Totals
from mapg_jax.training.trainer import Trainer

LOG = logging.getLogger(__name__)
DIVERGED = "numbers are no longer finite"
BROKEN_SHARE = 0.01
"""Of the environments: so many broken steps in a chunk are pardoned, and one at least."""


class DivergedError(ArithmeticError):
    """What a run learns from, or learns, is no longer finite; the message begins with DIVERGED."""


class Member:
    """A run alone, or one of several in lockstep."""

    def __init__(self, folder: RunFolder):
        self.folder, self.config = folder, folder.config
        self.checkpoints = self._checkpoints(folder.checkpoints, folder.config.checkpoints_kept)
        self.seconds_before = 0.0  # of earlier processes
        self.failure: DivergedError | None = None
        self._broken = 0.0  # steps since the last row, as of the chunk before

    def _checkpoints(self, path: pathlib.Path, kept: int) -> Checkpoints:
        return Checkpoints(path, kept, self.folder.digest, self.config.shards)

    def load(self, shapes: Any, step: int) -> Any:
        """The state of a checkpoint; one that is damaged is set aside.

        Raises:
          DamagedError: if it is.
          ValueError: if it is of another configuration, or nothing is left but the agent, or
            metrics.csv is not what the run had written until then.
        """
        if not self.checkpoints.can_go_on(step) and self.folder.scored_steps() >= step:
            raise ValueError(
                f"{self.folder.path} finished without keeping its replay, so that it cannot be "
                "trained further; train it anew, or sweep with --keep-replay"
            )
        state, host = self._undamaged(shapes, step)
        if host["metrics"] != rows_digest(self.folder.metrics, step):
            raise ValueError(
                f"{self.folder.metrics} is damaged: up to step {step:,} its rows are not those "
                "that were written"
            )
        self.seconds_before = float(host["seconds"])
        if isinstance(self.config, ReplayConfig) and not self.config.save_replay:
            LOG.warning(
                "%s was saved without its replay, which is filled anew: its numbers are not those "
                "of a run that never stopped",
                self.folder.path,
            )
        return state

    def _undamaged(self, shapes: Any, step: int) -> tuple[Any, dict[str, Any]]:
        """A state and the host's numbers; what is damaged on one host is so on all."""
        elsewhere = DamagedError(f"another host finds the checkpoint {step} damaged")
        try:
            return hosts.by_all(lambda: self.checkpoints.load(shapes, step), elsewhere)
        except DamagedError as damage:
            self.checkpoints.set_aside(damage, step)
            raise

    def begin_to_save(self, state: Any, seconds: float) -> None:
        """Begins a checkpoint of a plain state, `seconds` into this process's part of the run."""
        metrics = rows_digest(self.folder.metrics, int(state.env_steps))
        host = {"seconds": self.seconds_before + seconds, "metrics": metrics}
        if isinstance(self.config, ReplayConfig) and not self.config.save_replay:
            state = state.replace(replay=replay.emptied(state.replay))
        self.checkpoints.begin_to_save(state, host)

    def metrics_file(self, env_steps: int) -> MetricsFile:
        """metrics.csv, cut back to `env_steps`; what came later goes, an earlier score too."""
        self.checkpoints.drop_leftovers()
        self.checkpoints.drop_after(env_steps)
        cut_metrics(self.folder.metrics, env_steps)
        self.folder.evaluation.unlink(missing_ok=True)
        return MetricsFile(self.folder.metrics, env_steps)

    def check_finite(self, learner: Any, diverged_at: int, totals: Totals, env_steps: int) -> None:
        """Notes a failure if a loss was not finite at a step, a parameter is not, or too many
        environments gave what is not.

        Args:
          learner: what is learnt.
          diverged_at: the step of the first metric that was not finite, or -1.
          totals: since the last row.
          env_steps: now.
        """
        broken = float(totals.broken)
        before = self._broken if broken >= self._broken else 0.0  # a row sets it back
        self._broken = broken
        at, what = env_steps, _not_finite(learner)
        if diverged_at >= 0:
            at, what = diverged_at, _not_finite(totals.update_metrics) or "a metric"
        elif not what and broken - before > max(1.0, BROKEN_SHARE * self.config.environments):
            what = f"observations or rewards of {broken - before:,.0f} steps"
        if what:
            self.checkpoints.wait()
            newest = self.checkpoints.newest()
            kept = f"the checkpoint at step {newest:,} stays" if newest else "no checkpoint was due"
            self.failure = DivergedError(f"{DIVERGED} at step {at:,} ({what}); {kept}")

    def save_for_inspection(self, state: Any) -> None:
        """The state of a run that failed, in `diverged/`; no run goes on from it."""
        path = self.folder.path / "diverged"
        if hosts.is_first():
            shutil.rmtree(path, ignore_errors=True)  # of an earlier process
        hosts.wait("nothing of an earlier process is left")
        self._checkpoints(path, 1).save(state, {})

    def row(
        self,
        trainer: Trainer,
        counters: tuple[Any, Any, Totals],
        played: Played,
        turns_per_second: float,
        seconds: float,
    ) -> dict[str, int | float]:
        """One row of metrics.csv; docs/metrics.md defines the columns.

        Args:
          trainer: of the run.
          counters: environment steps, updates and totals.
          played: the episodes of the evaluation.
          turns_per_second: since the last row.
          seconds: of this process.
        """
        env_steps, all_updates, totals = counters
        summary = summarize(played.returns)
        totals = jax.tree.map(float, totals)
        updates, episodes = totals.updates or math.nan, totals.episodes or math.nan
        return {
            "env_steps": int(env_steps),
            "updates": int(all_updates),
            "return_mean": summary.mean,
            "return_std": summary.std,
            "episodes": summary.episodes,
            "episode_length": float(jnp.mean(played.lengths)),
            "training_return": totals.episode_return / episodes,
            "training_episode_length": totals.episode_length / episodes,
            "training_episodes": int(totals.episodes),
            "broken_steps": int(totals.broken),
            **{k: v / updates for k, v in totals.update_metrics._asdict().items()},
            **{k: float(v) for k, v in played.heads._asdict().items()},
            **{
                own.name: own.over(np.asarray(played.metrics[own.metric]))
                for own in trainer.env.scored_metrics
            },
            "steps_per_second": turns_per_second * trainer.steps_per_turn,
            "updates_per_second": turns_per_second
            * float(trainer.turn.updates_ratio * trainer.steps_per_turn),
            "seconds": self.seconds_before + seconds,
        }


def _not_finite(tree: Any) -> str:
    """The name of a leaf that is not finite, or nothing."""
    for path, leaf in jax.tree_util.tree_leaves_with_path(tree):
        if not np.isfinite(leaf).all():
            return jax.tree_util.keystr(path).lstrip(".")
    return ""
