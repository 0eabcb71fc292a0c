"""InvertedDoublePendulum: two poles in a chain on a cart, to be kept upright."""

import dataclasses
from typing import ClassVar

from envs.mujoco_tasks.task import MujocoTask, uniform_and_normal_offset

TARGET_HEIGHT, MIN_HEIGHT = 2.0, 1.0  # of the tip, m


@dataclasses.dataclass(frozen=True, eq=False)
class InvertedDoublePendulum(MujocoTask):
    """Gymnasium's InvertedDoublePendulum-v5.

    action       [1] force on the cart
    observation  [9] x of the cart (m), sines and cosines of the two angles, velocities of the cart
                 (m/s) and of the angles (rad/s) and the constraint force on the cart (N), clipped
                 to ±10
    reward       healthy reward - 0.01 x² - (z - 2)² of the tip - 0.001 ω₁² - 0.005 ω₂²
    start        positions uniform within ±reset_noise_scale, velocities normal with that deviation
    end          the tip is at most 1 m high
    """

    fields: ClassVar[tuple[str, ...]] = ("site_xpos", "qfrc_constraint")

    xml_file: str = "inverted_double_pendulum.xml"
    frame_skip: int = 5
    healthy_reward: float = 10.0
    reset_noise_scale: float = 0.1

    def start_offset(self, key):
        return uniform_and_normal_offset(key, self.reset_noise_scale, self.model.nq, self.model.nv)

    def observation(self, xp, physics):
        angles = physics.qpos[..., 1:]
        return xp.concatenate(
            [
                physics.qpos[..., :1],
                xp.sin(angles),
                xp.cos(angles),
                xp.clip(physics.qvel, -10, 10),
                xp.clip(physics.qfrc_constraint[..., :1], -10, 10),
            ],
            -1,
        )

    def reward(self, xp, anchor, physics, control):
        x, z = physics.site_xpos[..., 0, 0], physics.site_xpos[..., 0, 2]
        distance = 0.01 * x**2 + (z - TARGET_HEIGHT) ** 2
        velocity = 1e-3 * physics.qvel[..., 1] ** 2 + 5e-3 * physics.qvel[..., 2] ** 2
        survive = self.healthy_reward * ~self.terminated(xp, physics)
        return survive - distance - velocity, {
            "reward_survive": survive,
            "distance_penalty": -distance,
            "velocity_penalty": -velocity,
        }

    def terminated(self, xp, physics):
        return physics.site_xpos[..., 0, 2] <= MIN_HEIGHT
