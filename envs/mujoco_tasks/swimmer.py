"""Swimmer: a chain of three links that swims in a plane."""

import dataclasses

from envs.mujoco_tasks.task import MujocoTask, plane_metrics, uniform_offset


@dataclasses.dataclass(frozen=True, eq=False)
class Swimmer(MujocoTask):
    """Gymnasium's Swimmer-v5.

    action       [2] torques at the two joints
    observation  [8] heading and two joint angles (rad), then the velocities of x, y (m/s) and of
                 the angles (rad/s)
    reward       w_forward · dx/dt - w_ctrl · ‖control‖²
    start        all positions and velocities uniform within ±reset_noise_scale
    end          never
    """

    xml_file: str = "swimmer.xml"
    frame_skip: int = 4
    forward_reward_weight: float = 1.0
    ctrl_cost_weight: float = 1e-4
    reset_noise_scale: float = 0.1
    exclude_current_positions_from_observation: bool = True

    def start_offset(self, key):
        return uniform_offset(key, self.reset_noise_scale, self.model.nq, self.model.nv)

    def observation(self, xp, physics):
        skip = 2 * int(self.exclude_current_positions_from_observation)
        return xp.concatenate([physics.qpos[..., skip:], physics.qvel], -1)

    def anchor(self, xp, physics):
        return physics.qpos[..., :2]

    def reward(self, xp, anchor, physics, control):
        position = physics.qpos[..., :2]
        velocity = (position - anchor) / self.dt
        forward = self.forward_reward_weight * velocity[..., 0]
        ctrl = self.ctrl_cost_weight * xp.square(control).sum(-1)
        return forward - ctrl, {
            "reward_forward": forward,
            "reward_ctrl": -ctrl,
            **plane_metrics(xp, position, velocity),
        }
