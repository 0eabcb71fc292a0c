"""Hopper: a one-legged robot that hops forward."""

import dataclasses
from typing import ClassVar

import numpy as np

from envs.mujoco_tasks.task import MujocoTask, uniform_offset


@dataclasses.dataclass(frozen=True, eq=False)
class Hopper(MujocoTask):
    gymnasium_id: ClassVar[str] = "Hopper-v5"

    xml_file: str = "hopper.xml"
    frame_skip: int = 4
    forward_reward_weight: float = 1.0
    ctrl_cost_weight: float = 1e-3
    healthy_reward: float = 1.0
    terminate_when_unhealthy: bool = True
    healthy_state_range: tuple[float, float] = (-100.0, 100.0)
    healthy_z_range: tuple[float, float] = (0.7, np.inf)  # m
    healthy_angle_range: tuple[float, float] = (-0.2, 0.2)  # rad
    reset_noise_scale: float = 5e-3
    exclude_current_positions_from_observation: bool = True

    def start_offset(self, key):
        return uniform_offset(key, self.reset_noise_scale, self.model.nq, self.model.nv)

    def observation(self, xp, physics):
        skip = int(self.exclude_current_positions_from_observation)
        velocity = xp.clip(physics.qvel, -10, 10)
        return xp.concatenate([physics.qpos[..., skip:], velocity], -1)

    def anchor(self, xp, physics):
        return physics.qpos[..., :1]

    def _healthy(self, xp, physics):
        low, high = self.healthy_state_range
        state = xp.concatenate([physics.qpos[..., 2:], physics.qvel], -1)
        z, angle = physics.qpos[..., 1], physics.qpos[..., 2]
        return (
            ((low < state) & (state < high)).all(-1)
            & (self.healthy_z_range[0] < z)
            & (z < self.healthy_z_range[1])
            & (self.healthy_angle_range[0] < angle)
            & (angle < self.healthy_angle_range[1])
        )

    def reward(self, xp, anchor, physics, control):
        x_velocity = (physics.qpos[..., 0] - anchor[..., 0]) / self.dt
        forward = self.forward_reward_weight * x_velocity
        survive = self.healthy_reward * self._healthy(xp, physics)
        ctrl = self.ctrl_cost_weight * xp.square(control).sum(-1)
        return forward + survive - ctrl, {
            "reward_forward": forward,
            "reward_ctrl": -ctrl,
            "reward_survive": survive,
            "x_position": physics.qpos[..., 0],
            "z_distance_from_origin": physics.qpos[..., 1] - self.model.qpos0[1],
            "x_velocity": x_velocity,
        }

    def terminated(self, xp, physics):
        return ~self._healthy(xp, physics) & self.terminate_when_unhealthy
