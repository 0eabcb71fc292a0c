"""HumanoidStandup: the humanoid lies on its back and is paid for the height of its torso."""

import dataclasses

import numpy as np

from envs.mujoco_tasks.humanoid_body import HumanoidBody


@dataclasses.dataclass(frozen=True, eq=False)
class HumanoidStandup(HumanoidBody):
    """Gymnasium's HumanoidStandup-v5.

    action       [17] torques; ±1 is ±0.4 of control, times each motor's gear
    observation  [348], or 376 with include_constant_zeros; see `HumanoidBody`
    reward       z / (seconds per physics step) + 1
                 - w_ctrl · ‖control‖² - w_impact · ‖contact forces‖² (clipped)
    start        lying at z = 0.105 m; positions and velocities uniform within
                 ±reset_noise_scale of that
    end          never
    """

    xml_file: str = "humanoidstandup.xml"
    uph_cost_weight: float = 1.0
    """Of no effect, as in Gymnasium."""
    impact_cost_weight: float = 0.5e-6
    impact_cost_range: tuple[float, float] = (-np.inf, 10.0)

    def reward(self, xp, anchor, physics, control):
        x, y, z = (physics.qpos[..., i] for i in range(3))
        linup = z / self.model.opt.timestep
        ctrl = self.control_cost(xp, control)
        impact = self.contact_cost(xp, physics, self.impact_cost_weight, self.impact_cost_range)
        return linup - ctrl - impact + 1.0, {
            "reward_linup": linup,
            "reward_quadctrl": -ctrl,
            "reward_impact": -impact,
            "x_position": x,
            "y_position": y,
            "z_distance_from_origin": z - self.model.qpos0[2],
            **self.tendon_metrics(physics),
        }
