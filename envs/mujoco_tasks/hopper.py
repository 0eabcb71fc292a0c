"""Hopper: a one-legged robot that hops forward."""

import dataclasses

import numpy as np

from envs.mujoco_tasks.planar_walker import PlanarWalker
from envs.mujoco_tasks.task import within


@dataclasses.dataclass(frozen=True, eq=False)
class Hopper(PlanarWalker):
    """Gymnasium's Hopper-v5.

    action       [3] torques at thigh, leg and foot
    observation  [11] z (m), pitch and three joint angles (rad), then the velocities of x, z (m/s)
                 and of the angles (rad/s), clipped to ±10
    reward       w_forward · dx/dt + healthy reward - w_ctrl · ‖control‖²
    start        upright at z = 1.25 m; positions and velocities uniform within
                 ±reset_noise_scale of that
    end          z, pitch or any other state but x outside its healthy range
    """

    published_k = 1.25
    xml_file: str = "hopper.xml"
    frame_skip: int = 4
    healthy_state_range: tuple[float, float] = (-100.0, 100.0)
    healthy_z_range: tuple[float, float] = (0.7, np.inf)  # m
    healthy_angle_range: tuple[float, float] = (-0.2, 0.2)  # rad

    def healthy(self, xp, physics):
        state = xp.concatenate([physics.qpos[..., 2:], physics.qvel], -1)
        return (
            within(state, self.healthy_state_range).all(-1)
            & within(physics.qpos[..., 1], self.healthy_z_range)
            & within(physics.qpos[..., 2], self.healthy_angle_range)
        )
