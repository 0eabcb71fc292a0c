"""Videos of a trained policy: what it does, and what all its heads propose."""

import importlib.util
import pathlib
from collections.abc import Iterator
from typing import Any

import jax
import numpy as np

import envs
from mapg_jax.runs.episode import player, record
from mapg_jax.runs.folder import RunFolder, refuse_nowhere
from mapg_jax.runs.policy import open_policy

SIZE = 480
"""Pixels, of a side of the picture."""
PANEL = 260
"""Pixels, of the width of what the heads propose."""
MOST_FRAMES_A_SECOND = 25.0
COLOURS = ("#4477aa", "#ee6677", "#228833", "#ccbb44", "#66ccee", "#aa3377", "#999999")
"""Of heads; Paul Tol's, which the colour-blind can tell apart. More heads begin anew."""


def film(
    folder: RunFolder,
    out: pathlib.Path | None = None,
    *,
    steps: int = 300,
    episodes: int = 1,
    seed: int = 0,
    select: str = "uniform",
) -> pathlib.Path:
    """Episodes of the newest checkpoint as an mp4 or an animated GIF, by the name's ending.

    Args:
      folder: of a run.
      out: the file; by default video.mp4 in the run folder, or video.gif where mp4 cannot be
        written.
      steps: of an episode, at most.
      episodes: one after the other.
      seed: of the starts and the heads.
      select: how one action is made of the M proposals.

    Raises:
      ValueError: if the file's ending is another, its folder, a package or a renderer is missing,
        or the environment has no pictures.
    """
    out = out or folder.path / ("video.mp4" if _has_mp4() else "video.gif")
    write = _writer(out)
    refuse_nowhere(out)
    if steps < 1 or episodes < 1:
        raise ValueError(f"steps and episodes must be at least 1, got {steps} and {episodes}")
    policy = open_policy(folder, seed, select)
    if type(policy.env).painter is envs.Env.painter:
        raise ValueError(f"{folder.path} is a run of {folder.config.env}, which has no pictures")
    paint = policy.env.painter(SIZE, SIZE)
    limit = min(steps, folder.config.episode_steps())
    played = record(policy, limit, episodes, seed, select)
    seconds = float(getattr(policy.env, "dt", 0.1))
    stride = max(1, round(1 / (MOST_FRAMES_A_SECOND * seconds)))
    frames = [
        frame for episode in played for frame in _frames(episode, paint, player(policy), stride)
    ]
    write(frames, min(MOST_FRAMES_A_SECOND, 1 / (stride * seconds)))
    return out


def _frames(
    episode: envs.Episode, paint: envs.Painter, asked: envs.Player, stride: int
) -> Iterator[np.ndarray]:
    """Every `stride`-th state of an episode beside what was proposed there, and its last one
    beside what led to it."""
    observations = episode.observations[:-1]
    proposals, values = asked.proposals(observations)
    told_apart = _tells_actions_apart(asked, observations, proposals.shape[-1])
    last = len(episode.actions)
    for t in (*range(0, last, stride), last):
        state = jax.tree.map(lambda leaf, t=t: np.asarray(leaf)[t], episode.states)
        k = min(t, last - 1)
        side = panel(proposals[k], values[k], episode.actions[k], told_apart)
        yield np.concatenate([paint(state), side], 1)


def _tells_actions_apart(asked: envs.Player, observations: np.ndarray, size: int) -> bool:
    """Whether the critic values actions, and not states alone."""
    three = np.broadcast_to(np.linspace(-1, 1, 3)[:, None], (len(observations), 3, size))
    return bool(np.ptp(asked.q_values(observations, three), axis=-1).any())


def panel(
    proposals: np.ndarray, values: np.ndarray, action: np.ndarray, told_apart: bool = True
) -> np.ndarray:
    """M proposals [M, A] as marks on a line for each dimension, and their values [M] as bars, if
    the critic tells actions apart; else the one value of the state.

    The action [A] that was taken is a black ring.
    """
    from PIL import Image, ImageDraw  # slow to import

    image = Image.new("RGB", (PANEL, SIZE), "#f6f6f6")
    draw = ImageDraw.Draw(image)
    dimensions, heads = proposals.shape[1], len(values)
    left, right = 20, PANEL - 20
    gap = min(28, (SIZE * 0.6) / max(1, dimensions))
    draw.text((left, 8), "proposed actions", "black")

    def across(number: Any) -> float:
        return left + (right - left) * (float(np.clip(number, -1, 1)) + 1) / 2

    for d in range(dimensions):
        y = 38 + gap * d
        draw.line((left, y, right, y), "#cccccc")
        for m in range(heads):
            x = across(proposals[m, d])
            draw.line((x, y - gap * 0.35, x, y + gap * 0.35), COLOURS[m % len(COLOURS)], 3)
        x = across(action[d])
        draw.ellipse((x - 5, y - 5, x + 5, y + 5), outline="black", width=2)
    top = int(38 + gap * dimensions + 16)
    if not told_apart:
        draw.text((left, top), f"the state's value V, {values.max():.5g}", "black")
        return np.asarray(image)
    draw.text((left, top), f"their values Q, {values.min():.5g} to {values.max():.5g}", "black")
    spread = max(float(values.max() - values.min()), 1e-9)
    height = min(18.0, (SIZE - top - 34) / heads)
    for m in range(heads):
        y, share = top + 24 + height * m, 0.05 + 0.95 * (values[m] - values.min()) / spread
        box = (left, y, left + (right - left) * share, y + height * 0.8)
        draw.rectangle(box, COLOURS[m % len(COLOURS)])
    return np.asarray(image)


def _has_mp4() -> bool:
    return importlib.util.find_spec("imageio_ffmpeg") is not None


def _writer(out: pathlib.Path):
    """(frames, frames a second) → the file; refused before anything is played."""
    import imageio.v3 as iio

    if out.suffix == ".gif":
        return lambda frames, rate: iio.imwrite(
            out, np.stack(frames), duration=1000 / rate, loop=0, plugin="pillow"
        )
    if out.suffix != ".mp4":
        raise ValueError(f"a video is written as .mp4 or .gif, got {out.name}")
    if not _has_mp4():
        raise ValueError("mp4 needs: pip install 'mapg-jax[video]'; or choose --out FILE.gif")
    return lambda frames, rate: iio.imwrite(
        out, np.stack(frames), fps=rate, plugin="FFMPEG", macro_block_size=4
    )
