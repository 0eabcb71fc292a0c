"""python -m benchmarks.sb3: its PPO with many cars in one jitted step, beside one."""

import statistics
import time

import gymnasium
import torch  # pyright: ignore[reportMissingImports]
from stable_baselines3 import PPO  # pyright: ignore[reportMissingImports]
from stable_baselines3.common.vec_env import (  # pyright: ignore[reportMissingImports]
    DummyVecEnv,
    VecEnv,
)

from envs.interop.stable_baselines3 import StableBaselinesEnv

CARS = 64
TASK = "mapg_jax:mapg/Driving-v0"
REPEATS = 3


def steps_per_second(env: VecEnv, steps: int, n_steps: int) -> float:
    """Of training, in minibatches of half a rollout, after the first rollout has compiled it."""
    model = PPO(
        "MlpPolicy", env, n_steps=n_steps, batch_size=n_steps * env.num_envs // 2, device="cpu"
    )
    model.learn(n_steps * env.num_envs)
    begun = time.perf_counter()
    model.learn(steps)
    return model.num_timesteps / (time.perf_counter() - begun)


def main() -> None:
    """Prints both and their ratio, medians of interleaved repeats."""
    torch.set_num_threads(1)
    many = StableBaselinesEnv(gymnasium.make_vec(TASK, num_envs=CARS, control_hz=10))
    one = DummyVecEnv([lambda: gymnasium.make(TASK, control_hz=10)])
    speeds = [
        (steps_per_second(many, 32_768, 32), steps_per_second(one, 4_096, 2_048))
        for _ in range(REPEATS)
    ]
    of_many, of_one = (statistics.median(column) for column in zip(*speeds, strict=True))
    print(f"{CARS} cars {of_many:,.0f} steps/s, one {of_one:,.0f}: {of_many / of_one:.1f} times")


if __name__ == "__main__":
    main()
