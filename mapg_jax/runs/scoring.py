"""A run's score: a saved policy over E episodes, on our physics or in Gymnasium itself."""

import functools
import math
import os
from typing import Any, Literal

import jax
import numpy as np

import envs
from mapg_jax.runs.folder import RunFolder, write_json
from mapg_jax.runs.host import precise
from mapg_jax.runs.memory import available_bytes
from mapg_jax.runs.policy import Policy, open_policy
from mapg_jax.runs.sealing import write_score
from mapg_jax.training.evaluation import play, summarize
from mapg_jax.training.state import tree_bytes

GYMNASIUM_BYTES = 1_000_000
"""Of one environment, about: a MuJoCo model and its data."""
Physics = Literal["auto", "native", "mjx", "mjx-warp", "jax", "gymnasium"]
"""What an evaluation runs on: `auto` is what the run's `engine` means on this machine,
`gymnasium` the official task."""


def evaluate(
    folder: RunFolder | str | os.PathLike,
    episodes: int | None = None,
    physics: Physics = "auto",
    select: str = "uniform",
    seed: int = 0,
) -> dict[str, Any]:
    """Scores the newest checkpoint, and writes the result into the run folder.

    The run's official score, by its own number of episodes and the defaults of the others, is
    evaluation.json; any other stands beside it, in evaluations/. See `score`.
    """
    if not isinstance(folder, RunFolder):
        folder = RunFolder.open(folder)
    official = folder.config.final_episodes, "auto", "uniform", 0
    episodes = official[0] if episodes is None else episodes
    record = score(folder, episodes, physics, select, seed)
    if (episodes, physics, select, seed) == official:
        record = write_score(folder, record)
    else:
        name = f"{record['physics']}-{select}-{episodes}-s{seed}.json"
        (folder.path / "evaluations").mkdir(exist_ok=True)
        write_json(folder.path / "evaluations" / name, record)
    return record


def score(
    folder: RunFolder,
    episodes: int = 100,
    physics: Physics = "auto",
    select: str = "uniform",
    seed: int = 0,
) -> dict[str, Any]:
    """The score of the newest checkpoint, as docs/metrics.md describes evaluation.json.

    Args:
      folder: of the run.
      episodes: E starts, one episode each.
      physics: what to run on.
      select: how one action is made of the M proposals.
      seed: of starts and heads.

    Raises:
      ValueError: if the run has no checkpoint, the environment lacks that physics, or so many
        episodes do not fit the memory.
    """
    if episodes < 1:
        raise ValueError(f"episodes must be at least 1, got {episodes}")
    policy = open_policy(folder, seed, select)
    play_in = _in_gymnasium if physics == "gymnasium" else _in_jax
    with precise():
        physics, returns, lengths, extra = play_in(folder, policy, episodes, physics, select, seed)
    summary = summarize(returns)
    return {
        "env": folder.config.env,
        "env_steps": policy.env_steps,
        "physics": physics,
        "select": select,
        "episodes": summary.episodes,
        "seed": seed,
        "mean": summary.mean,
        "std": summary.std,
        "ci95": list(summary.ci95),
        "returns": [float(x) for x in returns],
        "lengths": [int(x) for x in lengths],
        **extra,
    }


def _in_jax(folder, policy: Policy, episodes, physics, select, seed):
    env = policy.env if physics == "auto" else folder.config.make_env(physics)
    each = tree_bytes(jax.eval_shape(env.reset, jax.random.key(0)))
    _refuse_too_many(episodes, each)
    played = jax.jit(
        functools.partial(
            play,
            env,
            policy.agent,
            episodes=episodes,
            time_limit=folder.config.episode_steps(),
            select=select,
        )
    )(policy.state, jax.random.key(seed))
    extra: dict[str, Any] = {
        k: float(v) if math.isfinite(v) else None for k, v in played.heads._asdict().items()
    }
    scored = {
        scored.metric: np.asarray(played.metrics[scored.metric]).tolist()
        for scored in env.scored_metrics
    }
    if scored:
        extra["metrics"] = scored
        extra["scored"] = {own.name: own.over(scored[own.metric]) for own in env.scored_metrics}
    return env.backend, np.asarray(played.returns), np.asarray(played.lengths), extra


def _in_gymnasium(folder, policy: Policy, episodes, physics, select, seed):
    import gymnasium  # slow to import

    config = folder.config
    env_id = envs.spec(config.env).gymnasium_id
    if env_id is None:
        raise ValueError(f"{config.env} equals no Gymnasium task; choose another --physics")
    _refuse_too_many(episodes, GYMNASIUM_BYTES)
    options = config.parsed_env_options()
    try:
        starts = [
            gymnasium.make(env_id, max_episode_steps=config.episode_steps(), **options)
            for _ in range(episodes)
        ]
    except TypeError as error:
        raise ValueError(f"{env_id} does not take all of this run's options: {error}") from None
    observations = np.stack([env.reset(seed=seed + i)[0] for i, env in enumerate(starts)])
    returns, lengths = np.zeros(episodes), np.zeros(episodes, int)
    alive = np.ones(episodes, bool)
    while alive.any():
        actions = policy(observations)  # of all, so that one program serves every step
        for i in np.flatnonzero(alive):
            observations[i], reward, terminated, truncated, _ = starts[i].step(actions[i])
            returns[i] += reward
            lengths[i] += 1
            alive[i] = not (terminated or truncated)
    for env in starts:
        env.close()
    return "gymnasium", returns, lengths, {}


def _refuse_too_many(episodes: int, each: int) -> None:
    """Raises ValueError if episodes of so many bytes do not fit the memory, side by side.

    A step holds two states of each, and what it computes in between.
    """
    needed, available = 4 * episodes * each, available_bytes()
    if needed > available or episodes >= 2**31:
        raise ValueError(
            f"{episodes:,} episodes side by side need {needed / 1e9:.1f} GB but "
            f"{available / 1e9:.1f} GB are available; choose fewer --episodes"
        )
