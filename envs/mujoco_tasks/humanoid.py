"""Humanoid: a two-legged robot with arms that walks in the direction of x."""

import dataclasses
from typing import ClassVar

import numpy as np

from envs.mujoco_tasks.humanoid_body import HumanoidBody
from envs.mujoco_tasks.task import plane_metrics, within


@dataclasses.dataclass(frozen=True, eq=False)
class Humanoid(HumanoidBody):
    """Gymnasium's Humanoid-v5.

    action       [17] torques; ±1 is ±0.4 of control, times each motor's gear
    observation  [348], or 376 with include_constant_zeros; see `HumanoidBody`
    reward       w_forward · dx/dt of the centre of mass + healthy reward
                 - w_ctrl · ‖control‖² - w_contact · ‖contact forces‖² (clipped)
    start        upright at z = 1.4 m; positions and velocities uniform within
                 ±reset_noise_scale of that
    end          z outside its healthy range
    """

    fields: ClassVar[tuple[str, ...]] = (*HumanoidBody.fields, "xipos")

    xml_file: str = "humanoid.xml"
    forward_reward_weight: float = 1.25
    contact_cost_weight: float = 5e-7
    contact_cost_range: tuple[float, float] = (-np.inf, 10.0)
    healthy_reward: float = 5.0
    terminate_when_unhealthy: bool = True
    healthy_z_range: tuple[float, float] = (1.0, 2.0)  # m

    def anchor(self, xp, physics):
        mass = self.model.body_mass
        return (mass[:, None] * physics.xipos[..., :2]).sum(-2) / mass.sum()

    def reward(self, xp, anchor, physics, control):
        velocity = (self.anchor(xp, physics) - anchor) / self.dt
        forward = self.forward_reward_weight * velocity[..., 0]
        survive = self.healthy_reward * within(physics.qpos[..., 2], self.healthy_z_range)
        ctrl = self.control_cost(xp, control)
        contact = self.contact_cost(xp, physics, self.contact_cost_weight, self.contact_cost_range)
        return forward + survive - ctrl - contact, {
            "reward_survive": survive,
            "reward_forward": forward,
            "reward_ctrl": -ctrl,
            "reward_contact": -contact,
            **plane_metrics(xp, physics.qpos[..., :2], velocity),
            **self.tendon_metrics(physics),
        }

    def terminated(self, xp, physics):
        healthy = within(physics.qpos[..., 2], self.healthy_z_range)
        return ~healthy & self.terminate_when_unhealthy
