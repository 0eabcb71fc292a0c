"""A peer learns a task with the settings that are published for it, until it is ended from outside.

Every evaluation is a row of FOLDER/metrics.csv, as ours writes it: that file is what is timed.

python -m benchmarks.peers.reach LIBRARY ALGORITHM TASK --seed SEED --out FOLDER
"""

import argparse
import importlib
import pathlib

from benchmarks.peers import known

EPISODES = 10
ENVIRONMENTS = {"pendulum": "Pendulum-v1", "halfcheetah": "HalfCheetah-v5", "hopper": "Hopper-v5"}
FOREVER = 1_000_000_000


class Rows:
    """metrics.csv, a row an evaluation."""

    def __init__(self, folder: pathlib.Path):
        folder.mkdir(parents=True)
        self._path = folder / "metrics.csv"
        self._path.write_text("env_steps,return_mean\n")

    def write(self, env_steps, return_mean) -> None:
        with self._path.open("a") as file:
            file.write(f"{int(env_steps)},{float(return_mean)}\n")


def with_stable_baselines(peer: known.Known, task: str, seed: int, rows: Rows) -> None:
    """Stable-Baselines3, or SBX, which has its classes."""
    import torch
    from stable_baselines3.common.callbacks import BaseCallback, EvalCallback
    from stable_baselines3.common.env_util import make_vec_env
    from stable_baselines3.common.vec_env import VecNormalize

    torch.set_num_threads(1)

    class Told(BaseCallback):
        """After every evaluation."""

        def _on_step(self) -> bool:
            rows.write(self.parent.num_timesteps, self.parent.last_mean_reward)
            return True

    training = make_vec_env(ENVIRONMENTS[task], peer.environments, seed=seed)
    playing = make_vec_env(ENVIRONMENTS[task], EPISODES, seed=seed + 1_000)  # side by side
    if peer.normalize:
        training = VecNormalize(training, gamma=peer.settings["gamma"])
        playing = VecNormalize(playing, training=False, norm_reward=False)
    package = importlib.import_module({"sb3": "stable_baselines3", "sbx": "sbx"}[peer.library])
    model = getattr(package, peer.algorithm)(
        "MlpPolicy", training, seed=seed, device="cpu", **_with_functions(peer)
    )
    evaluation = EvalCallback(
        playing,
        callback_after_eval=Told(),
        n_eval_episodes=EPISODES,
        eval_freq=peer.evaluate_every // peer.environments,
        verbose=0,
    )
    model.learn(FOREVER, callback=evaluation)


def _with_functions(peer: known.Known) -> dict:
    """The settings, with an activation in the place of its name."""
    settings = dict(peer.settings)
    networks = settings.get("policy_kwargs", {})
    if networks.get("activation_fn") == "relu":
        if peer.library == "sb3":
            from torch.nn import ReLU as relu
        else:
            from flax.linen import relu
        settings["policy_kwargs"] = networks | {"activation_fn": relu}
    return settings


def with_rejax(peer: known.Known, task: str, seed: int, rows: Rows) -> None:
    """Training is one program, which tells of its evaluations from inside."""
    import gymnax
    import jax
    import jax.numpy as jnp
    from jax.experimental import io_callback
    from rejax import get_algo
    from rejax.evaluate import evaluate

    from benchmarks.peers.rejax_td3 import FiveValues

    def evaluated(algorithm, state, key):
        act = algorithm.make_act(state)
        _, returns = evaluate(act, key, algorithm.env, algorithm.env_params, EPISODES)
        io_callback(rows.write, None, state.global_step, returns.mean(), ordered=True)
        return jnp.zeros(())

    algorithm = get_algo(peer.algorithm.lower()).create(
        env=FiveValues(gymnax.make(ENVIRONMENTS[task])[0]),
        total_timesteps=FOREVER,
        eval_freq=peer.evaluate_every,
        skip_initial_evaluation=True,
        **peer.settings,
    )
    algorithm = algorithm.replace(eval_callback=evaluated)
    jax.block_until_ready(jax.jit(algorithm.train)(jax.random.PRNGKey(seed)))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("library", choices=list(known.LIBRARIES))
    parser.add_argument("algorithm")
    parser.add_argument("task", choices=list(ENVIRONMENTS))
    parser.add_argument("--seed", type=int, required=True)
    parser.add_argument("--out", type=pathlib.Path, required=True)
    arguments = parser.parse_args()
    name = arguments.library, arguments.algorithm
    peer = next(x for x in known.PEERS[arguments.task] if (x.library, x.algorithm) == name)
    learn = with_rejax if peer.library == "rejax" else with_stable_baselines
    learn(peer, arguments.task, arguments.seed, Rows(arguments.out))


if __name__ == "__main__":
    main()
