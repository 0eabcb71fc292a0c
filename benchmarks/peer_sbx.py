"""sbx-rl's DDPG with our settings; prints environment steps per second. Runs in .venv-peers."""

import sys
import time

import gymnasium
from sbx import DDPG
from stable_baselines3.common.callbacks import BaseCallback

WARM_UP = 1000  # steps: compiled and learning


class Stopwatch(BaseCallback):
    """Times the steps after the warm-up."""

    started = 0.0

    def _on_step(self) -> bool:
        if self.num_timesteps == WARM_UP:
            self.started = time.perf_counter()
        return True


def main(steps: int) -> None:
    model = DDPG(
        "MlpPolicy",
        gymnasium.make("HalfCheetah-v5"),
        learning_rate=1e-3,
        batch_size=64,
        buffer_size=1_000_000,
        learning_starts=100,
        train_freq=1,
        gradient_steps=1,
        tau=0.01,
        policy_kwargs={"net_arch": [64, 64]},
    )
    watch = Stopwatch()
    model.learn(WARM_UP + steps, callback=watch)
    print(steps / (time.perf_counter() - watch.started))


if __name__ == "__main__":
    main(int(sys.argv[1]))
