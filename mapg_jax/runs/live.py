"""Episodes of a trained policy in MuJoCo's viewer, at the pace of the simulated clock."""

import time

import jax
import numpy as np

import envs
from mapg_jax.runs.episode import player, record
from mapg_jax.runs.folder import RunFolder
from mapg_jax.runs.policy import open_policy


def show(
    folder: RunFolder,
    *,
    steps: int = 300,
    episodes: int = 1,
    seed: int = 0,
    select: str = "uniform",
) -> None:
    """Plays episodes of the newest checkpoint in a window, until they end or it is closed.

    Args:
      folder: of a run.
      steps: of an episode, at most.
      episodes: one after the other.
      seed: of the starts and the heads.
      select: how one action is made of the M proposals, which are shown in a corner.

    Raises:
      ValueError: if the environment has no viewer, or there is no display.
    """
    if steps < 1 or episodes < 1:
        raise ValueError(f"steps and episodes must be at least 1, got {steps} and {episodes}")
    policy = open_policy(folder, seed, select)
    if type(policy.env).viewer is envs.Env.viewer:
        raise ValueError(
            f"{folder.path} is a run of {folder.config.env}, which MuJoCo's viewer cannot show; "
            "leave out --live for a video"
        )
    asked, seconds = player(policy), float(getattr(policy.env, "dt", 0.1))
    limit = min(steps, folder.config.episode_steps())
    window = policy.env.viewer()  # refuses before anything is played
    played = record(policy, limit, episodes, seed, select)
    with window as shown:
        for episode in played:
            proposals, values = asked.proposals(episode.observations[:-1])
            for t in range(len(episode.actions)):
                due = time.monotonic() + seconds
                state = jax.tree.map(lambda leaf, t=t: np.asarray(leaf)[t], episode.states)
                if not shown(state, *columns(proposals[t], values[t], episode.actions[t])):
                    return
                time.sleep(max(0.0, due - time.monotonic()))


def columns(proposals: np.ndarray, values: np.ndarray, action: np.ndarray) -> tuple[str, str]:
    """The heads, with a * where one proposed the action [A]; their values [M] and proposals [M, A].

    A line a head, below a line that says what they are.
    """
    left, right = ["head"], ["value, proposed action"]
    for m, (proposed, value) in enumerate(zip(proposals, values, strict=True)):
        left.append(f"{m}{'*' * np.allclose(proposed, action, atol=1e-5)}")
        right.append(f"{value:.4g}  {' '.join(f'{x:+.2f}' for x in proposed)}")
    return "\n".join(left), "\n".join(right)
