"""DDPG of Stable-Baselines3 (PyTorch) or of sbx-rl (JAX) on HalfCheetah-v5.

python -m benchmarks.peers.stable_baselines sb3|sbx STEPS
"""

import importlib
import sys
import time

import gymnasium
from stable_baselines3.common.callbacks import BaseCallback

from benchmarks import peers, products

MODULES = {"sb3": "stable_baselines3", "sbx": "sbx"}


class Stopwatch(BaseCallback):
    """Times the steps after the warm-up."""

    started = 0.0

    def _on_step(self) -> bool:
        if self.num_timesteps == peers.WARM_UP:
            self.started = time.perf_counter()
        return True


def main(library: str, steps: int) -> None:
    if library == "sb3":
        import torch

        torch.set_num_threads(1)
    model = importlib.import_module(MODULES[library]).DDPG(
        "MlpPolicy",
        gymnasium.make("HalfCheetah-v5"),
        learning_rate=1e-3,
        batch_size=products.BATCH,
        buffer_size=1_000_000,
        learning_starts=100,
        train_freq=1,
        gradient_steps=1,
        tau=0.01,
        policy_kwargs={"net_arch": list(products.HIDDEN)},
    )
    watch = Stopwatch()
    model.learn(peers.WARM_UP + steps, callback=watch)
    rate = steps / (time.perf_counter() - watch.started)
    floor = products.torch_microseconds if library == "sb3" else products.jax_microseconds
    peers.tell(rate, floor(products.of_ddpg(products.HALFCHEETAH)))


if __name__ == "__main__":
    main(sys.argv[1], int(sys.argv[2]))
