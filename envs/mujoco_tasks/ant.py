"""Ant: a four-legged robot that walks in the direction of x."""

import dataclasses
from typing import ClassVar

from envs.mujoco_tasks.task import MujocoTask, flat, plane_metrics, uniform_and_normal_offset


@dataclasses.dataclass(frozen=True, eq=False)
class Ant(MujocoTask):
    """Gymnasium's Ant-v5.

    action       [8] torques at hip and ankle of each leg
    observation  [105] z (m), orientation (quaternion) and eight joint angles (rad); velocity (m/s)
                 and angular velocity (rad/s) of the torso and of the joints (rad/s); contact torque
                 (N m) and force (N) on each of 13 bodies, clipped to contact_force_range
    reward       w_forward · dx/dt + healthy reward - w_ctrl · ‖control‖² - w_contact · ‖forces‖²
    start        upright at z = 0.75 m; positions uniform within ±reset_noise_scale, velocities
                 normal with that deviation
    end          z outside its healthy range, or a state that is not finite
    """

    fields: ClassVar[tuple[str, ...]] = ("xpos", "cfrc_ext")

    xml_file: str = "ant.xml"
    frame_skip: int = 5
    forward_reward_weight: float = 1.0
    ctrl_cost_weight: float = 0.5
    contact_cost_weight: float = 5e-4
    healthy_reward: float = 1.0
    main_body: int | str = 1
    """The body whose displacement is rewarded."""
    terminate_when_unhealthy: bool = True
    healthy_z_range: tuple[float, float] = (0.2, 1.0)  # m
    contact_force_range: tuple[float, float] = (-1.0, 1.0)  # N, N m
    reset_noise_scale: float = 0.1
    exclude_current_positions_from_observation: bool = True
    include_cfrc_ext_in_observation: bool = True

    def start_offset(self, key):
        return uniform_and_normal_offset(key, self.reset_noise_scale, self.model.nq, self.model.nv)

    def observation(self, xp, physics):
        skip = 2 * int(self.exclude_current_positions_from_observation)
        parts = [physics.qpos[..., skip:], physics.qvel]
        if self.include_cfrc_ext_in_observation:
            parts.append(flat(self._contact_forces(xp, physics)[..., 1:, :]))
        return xp.concatenate(parts, -1)

    def anchor(self, xp, physics):
        return physics.xpos[..., self.model.body(self.main_body).id, :2]

    def reward(self, xp, anchor, physics, control):
        velocity = (self.anchor(xp, physics) - anchor) / self.dt
        forward = self.forward_reward_weight * velocity[..., 0]
        survive = self.healthy_reward * self._healthy(xp, physics)
        ctrl = self.ctrl_cost_weight * xp.square(control).sum(-1)
        forces = flat(self._contact_forces(xp, physics))
        contact = self.contact_cost_weight * xp.square(forces).sum(-1)
        return forward + survive - ctrl - contact, {
            "reward_forward": forward,
            "reward_ctrl": -ctrl,
            "reward_contact": -contact,
            "reward_survive": survive,
            **plane_metrics(xp, physics.qpos[..., :2], velocity),
        }

    def terminated(self, xp, physics):
        return ~self._healthy(xp, physics) & self.terminate_when_unhealthy

    def _healthy(self, xp, physics):
        low, high = self.healthy_z_range
        z = physics.qpos[..., 2]
        finite = xp.isfinite(physics.qpos).all(-1) & xp.isfinite(physics.qvel).all(-1)
        return finite & (low <= z) & (z <= high)

    def _contact_forces(self, xp, physics):
        return xp.clip(physics.cfrc_ext, *self.contact_force_range)
