"""Reacher: an arm of two links in a plane, whose fingertip is to reach a target."""

import dataclasses
from typing import ClassVar

import jax
import jax.numpy as jnp
import numpy as np

from envs.mujoco_tasks.task import MujocoTask, uniform

MAX_TARGET_RADIUS = 0.2  # m
START_ANGLE, START_VELOCITY = 0.1, 0.005  # rad, rad/s


@dataclasses.dataclass(frozen=True, eq=False)
class Reacher(MujocoTask):
    """Gymnasium's Reacher-v5.

    action       [2] torques at the two joints
    observation  [10] cosines, then sines of the two angles, x and y of the target (m), angular
                 velocities (rad/s), x and y of the vector from target to fingertip (m)
    reward       -w_dist · (distance of fingertip and target) - w_control · ‖control‖²
    start        angles uniform within ±0.1 rad and their velocities within ±0.005 rad/s; the target
                 at rest, uniform in a disc of 0.2 m
    end          never
    """

    fields: ClassVar[tuple[str, ...]] = ("xpos",)

    xml_file: str = "reacher.xml"
    frame_skip: int = 2
    reward_dist_weight: float = 1.0
    reward_control_weight: float = 1.0

    def start_offset(self, key):
        angle_key, velocity_key, radius_key, direction_key = jax.random.split(key, 4)
        angles = uniform(angle_key, START_ANGLE, 2)
        velocities = uniform(velocity_key, START_VELOCITY, 2)
        # The area of a disc grows with the square of its radius.
        radius = MAX_TARGET_RADIUS * jnp.sqrt(jax.random.uniform(radius_key))
        direction = jax.random.uniform(direction_key, maxval=2 * np.pi)
        target = radius * jnp.stack([jnp.cos(direction), jnp.sin(direction)])
        return (
            jnp.concatenate([angles, target - self.model.qpos0[2:].astype(np.float32)]),
            jnp.concatenate([velocities, jnp.zeros(2)]),
        )

    def observation(self, xp, physics):
        angles, target = physics.qpos[..., :2], physics.qpos[..., 2:]
        return xp.concatenate(
            [
                xp.cos(angles),
                xp.sin(angles),
                target,
                physics.qvel[..., :2],
                self._from_target(physics)[..., :2],
            ],
            -1,
        )

    def reward(self, xp, anchor, physics, control):
        dist = -self.reward_dist_weight * xp.linalg.norm(self._from_target(physics), axis=-1)
        ctrl = -self.reward_control_weight * xp.square(control).sum(-1)
        return dist + ctrl, {"reward_dist": dist, "reward_ctrl": ctrl}

    def _from_target(self, physics):
        body = self.model.body
        return physics.xpos[..., body("fingertip").id, :] - physics.xpos[..., body("target").id, :]
