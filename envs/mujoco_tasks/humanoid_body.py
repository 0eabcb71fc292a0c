"""What Humanoid and HumanoidStandup share: one body, and a long observation of it."""

import dataclasses
from typing import ClassVar

from envs.mujoco_tasks.task import MujocoTask, flat, uniform_offset


@dataclasses.dataclass(frozen=True, eq=False)
class HumanoidBody(MujocoTask):
    """A humanoid of 13 bodies, 17 motors and two tendons, from hip to knee; see its subclasses.

    The observation, in order: positions without x and y [22], velocities [23]; of each body inertia
    and mass about the robot's centre of mass (`cinert`) [130] and velocity there (`cvel`) [78]; the
    motors' torques (N m) [17]; contact torque (N m) and force (N) on each body [78].
    """

    fields: ClassVar[tuple[str, ...]] = (
        "cinert",
        "cvel",
        "qfrc_actuator",
        "cfrc_ext",
        "ten_length",
        "ten_velocity",
    )

    frame_skip: int = 5
    ctrl_cost_weight: float = 0.1
    reset_noise_scale: float = 1e-2
    exclude_current_positions_from_observation: bool = True
    include_cinert_in_observation: bool = True
    include_cvel_in_observation: bool = True
    include_qfrc_actuator_in_observation: bool = True
    include_cfrc_ext_in_observation: bool = True
    include_constant_zeros: bool = False
    """Keep the 28 entries that are always zero, as Gymnasium's v4 did (376 in all): those of the
    world body and the torques on the root's six degrees of freedom, which no motor drives."""

    def start_offset(self, key):
        return uniform_offset(key, self.reset_noise_scale, self.model.nq, self.model.nv)

    def observation(self, xp, physics):
        skip = 2 * int(self.exclude_current_positions_from_observation)
        first_body, first_dof = (0, 0) if self.include_constant_zeros else (1, 6)
        parts = [physics.qpos[..., skip:], physics.qvel]
        if self.include_cinert_in_observation:
            parts.append(flat(physics.cinert[..., first_body:, :]))
        if self.include_cvel_in_observation:
            parts.append(flat(physics.cvel[..., first_body:, :]))
        if self.include_qfrc_actuator_in_observation:
            parts.append(physics.qfrc_actuator[..., first_dof:])
        if self.include_cfrc_ext_in_observation:
            parts.append(flat(physics.cfrc_ext[..., first_body:, :]))
        return xp.concatenate(parts, -1)

    def control_cost(self, xp, control):
        """w_ctrl · ‖control‖²"""
        return self.ctrl_cost_weight * xp.square(control).sum(-1)

    def contact_cost(self, xp, physics, weight, cost_range):
        """weight · ‖contact forces on all bodies‖², clipped to `cost_range`."""
        return xp.clip(weight * xp.square(flat(physics.cfrc_ext)).sum(-1), *cost_range)

    def tendon_metrics(self, physics):
        """Length (m) and velocity (m/s) of each tendon."""
        return {
            f"tendon_{name}_{i}": values[..., i]
            for name, values in (
                ("length", physics.ten_length),
                ("velocity", physics.ten_velocity),
            )
            for i in range(self.model.ntendon)
        }
