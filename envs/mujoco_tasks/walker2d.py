"""Walker2d: a two-legged robot that walks forward."""

import dataclasses

from envs.mujoco_tasks.planar_walker import PlanarWalker
from envs.mujoco_tasks.task import within


@dataclasses.dataclass(frozen=True, eq=False)
class Walker2d(PlanarWalker):
    """Gymnasium's Walker2d-v5.

    action       [6] torques at thigh, leg and foot, right then left
    observation  [17] z (m), pitch and six joint angles (rad), then the velocities of x, z (m/s) and
                 of the angles (rad/s), clipped to ±10
    reward       w_forward · dx/dt + healthy reward - w_ctrl · ‖control‖²
    start        upright at z = 1.25 m; positions and velocities uniform within
                 ±reset_noise_scale of that
    end          z or pitch outside its healthy range
    """

    published_k = 0.25
    xml_file: str = "walker2d_v5.xml"
    frame_skip: int = 4
    healthy_z_range: tuple[float, float] = (0.8, 2.0)  # m
    healthy_angle_range: tuple[float, float] = (-1.0, 1.0)  # rad

    def healthy(self, xp, physics):
        z, pitch = physics.qpos[..., 1], physics.qpos[..., 2]
        return within(z, self.healthy_z_range) & within(pitch, self.healthy_angle_range)
