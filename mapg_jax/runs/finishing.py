"""The end of a run: its curve, its score, and whether its replay stays on disk."""

from typing import Any

from mapg_jax.runs.checkpoints import Checkpoints
from mapg_jax.runs.curve import draw_curve
from mapg_jax.runs.folder import RunFolder
from mapg_jax.runs.metrics import read_metrics
from mapg_jax.runs.scoring import evaluate


def finish(folder: RunFolder, keep_replay: bool = True) -> dict[str, Any]:
    """Draws the curve and scores the last policy (evaluation seed 0); gives the score.

    Args:
      folder: of a run that took all its steps.
      keep_replay: whether `mapg resume --steps` will be able to train it further.
    """
    config = folder.config
    if not keep_replay:
        Checkpoints(folder.checkpoints).drop_replay()
    if read_metrics(folder.metrics):  # one that was stopped early may have no evaluation
        draw_curve(
            folder.metrics, folder.curve, f"{config.env}, {config.label}, seed {config.seed}"
        )
    return evaluate(folder)


def is_finished(folder: RunFolder) -> bool:
    """Whether all steps are taken and the last policy is scored."""
    rows = read_metrics(folder.metrics)
    whole = bool(rows) and rows[-1]["env_steps"] >= folder.config.steps
    scored = folder.scored_steps() >= folder.config.steps
    return whole and scored and folder.curve.exists()
