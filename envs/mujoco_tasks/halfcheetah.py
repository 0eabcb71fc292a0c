"""HalfCheetah: a planar robot with two legs and a long body that runs forward."""

import dataclasses

from envs.mujoco_tasks.task import MujocoTask, uniform_and_normal_offset


@dataclasses.dataclass(frozen=True, eq=False)
class HalfCheetah(MujocoTask):
    """Gymnasium's HalfCheetah-v5.

    action       [6] torques at thigh, shin and foot, back then front
    observation  [17] z (m), pitch and six joint angles (rad), then the velocities of x, z (m/s) and
                 of the angles (rad/s)
    reward       w_forward · dx/dt - w_ctrl · ‖control‖²
    start        positions uniform within ±reset_noise_scale, velocities normal with that deviation
    end          never
    """

    published_k = 0.25
    xml_file: str = "half_cheetah.xml"
    frame_skip: int = 5
    forward_reward_weight: float = 1.0
    ctrl_cost_weight: float = 0.1
    reset_noise_scale: float = 0.1
    exclude_current_positions_from_observation: bool = True

    def start_offset(self, key):
        return uniform_and_normal_offset(key, self.reset_noise_scale, self.model.nq, self.model.nv)

    def observation(self, xp, physics):
        skip = int(self.exclude_current_positions_from_observation)
        return xp.concatenate([physics.qpos[..., skip:], physics.qvel], -1)

    def anchor(self, xp, physics):
        return physics.qpos[..., :1]

    def reward(self, xp, anchor, physics, control):
        x = physics.qpos[..., 0]
        x_velocity = (x - anchor[..., 0]) / self.dt
        forward = self.forward_reward_weight * x_velocity
        ctrl = self.ctrl_cost_weight * xp.square(control).sum(-1)
        return forward - ctrl, {
            "reward_forward": forward,
            "reward_ctrl": -ctrl,
            "x_position": x,
            "x_velocity": x_velocity,
        }
