"""Pusher: an arm of seven joints that pushes a cylinder to a goal."""

import dataclasses
from typing import ClassVar

import jax
import jax.numpy as jnp
import numpy as np

from envs.mujoco_tasks.task import MujocoTask, uniform

ARM = 7  # joints; y and x of the object follow, then those of the goal
OBJECT_LOW = np.array([-0.3, -0.2], np.float32)  # y and x from the goal, m
OBJECT_HIGH = np.array([0.0, 0.2], np.float32)
MIN_DISTANCE = 0.17  # of object and goal at the start, m
START_VELOCITY = 0.005  # rad/s


@dataclasses.dataclass(frozen=True, eq=False)
class Pusher(MujocoTask):
    """Gymnasium's Pusher-v5.

    action       [7] torques; ±1 is ±2 of control
    observation  [23] joint angles (rad), joint velocities (rad/s), then x, y, z of the fingertip,
                 the object and the goal (m)
    reward       -w_near · (distance of fingertip and object) - w_dist · (distance of object and
                 goal) - w_control · ‖control‖²
    start        the arm at its zero position, with velocities uniform within ±0.005 rad/s; the
                 object at rest, uniform in a rectangle, at least 0.17 m from the goal
    end          never
    """

    fields: ClassVar[tuple[str, ...]] = ("xpos",)

    xml_file: str = "pusher_v5.xml"
    frame_skip: int = 5
    reward_near_weight: float = 0.5
    reward_dist_weight: float = 1.0
    reward_control_weight: float = 0.1

    def start_offset(self, key):
        object_key, velocity_key = jax.random.split(key)
        velocities = uniform(velocity_key, START_VELOCITY, ARM)
        return (
            jnp.concatenate([jnp.zeros(ARM), _object_position(object_key), jnp.zeros(2)]),
            jnp.concatenate([velocities, jnp.zeros(4)]),
        )

    def observation(self, xp, physics):
        return xp.concatenate(
            [
                physics.qpos[..., :ARM],
                physics.qvel[..., :ARM],
                self._position(physics, "tips_arm"),
                self._position(physics, "object"),
                self._position(physics, "goal"),
            ],
            -1,
        )

    def reward(self, xp, anchor, physics, control):
        thing = self._position(physics, "object")
        to_tip = thing - self._position(physics, "tips_arm")
        to_goal = thing - self._position(physics, "goal")
        near = -self.reward_near_weight * xp.linalg.norm(to_tip, axis=-1)
        dist = -self.reward_dist_weight * xp.linalg.norm(to_goal, axis=-1)
        ctrl = -self.reward_control_weight * xp.square(control).sum(-1)
        return dist + ctrl + near, {
            "reward_dist": dist,
            "reward_ctrl": ctrl,
            "reward_near": near,
        }

    def _position(self, physics, body):
        return physics.xpos[..., self.model.body(body).id, :]


def _object_position(key: jax.Array) -> jax.Array:
    """y and x, [2] m: uniform in the rectangle, drawn until outside the disc round the goal."""

    def draw(number):
        key_of_draw = jax.random.fold_in(key, number)
        return jax.random.uniform(key_of_draw, (2,), minval=OBJECT_LOW, maxval=OBJECT_HIGH)

    def too_near(number):
        return jnp.linalg.norm(draw(number)) <= MIN_DISTANCE

    return draw(jax.lax.while_loop(too_near, lambda number: number + 1, 0))
