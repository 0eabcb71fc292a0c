"""What Hopper and Walker2d share: legs in the vertical plane, paid to go forward and to stay up."""

import dataclasses

from envs.mujoco_tasks.task import MujocoTask, uniform_offset


@dataclasses.dataclass(frozen=True, eq=False)
class PlanarWalker(MujocoTask):
    """A body whose first three coordinates are x [m], z [m] and pitch [rad]; see its subclasses."""

    forward_reward_weight: float = 1.0
    ctrl_cost_weight: float = 1e-3
    healthy_reward: float = 1.0
    terminate_when_unhealthy: bool = True
    reset_noise_scale: float = 5e-3
    exclude_current_positions_from_observation: bool = True

    def healthy(self, xp, physics):
        """Whether the body is up, [...] bool."""
        raise NotImplementedError

    def start_offset(self, key):
        return uniform_offset(key, self.reset_noise_scale, self.model.nq, self.model.nv)

    def observation(self, xp, physics):
        skip = int(self.exclude_current_positions_from_observation)
        velocity = xp.clip(physics.qvel, -10, 10)
        return xp.concatenate([physics.qpos[..., skip:], velocity], -1)

    def anchor(self, xp, physics):
        return physics.qpos[..., :1]

    def reward(self, xp, anchor, physics, control):
        x, z = physics.qpos[..., 0], physics.qpos[..., 1]
        x_velocity = (x - anchor[..., 0]) / self.dt
        forward = self.forward_reward_weight * x_velocity
        survive = self.healthy_reward * self.healthy(xp, physics)
        ctrl = self.ctrl_cost_weight * xp.square(control).sum(-1)
        return forward + survive - ctrl, {
            "reward_forward": forward,
            "reward_ctrl": -ctrl,
            "reward_survive": survive,
            "x_position": x,
            "z_distance_from_origin": z - self.model.qpos0[1],
            "x_velocity": x_velocity,
        }

    def terminated(self, xp, physics):
        return ~self.healthy(xp, physics) & self.terminate_when_unhealthy
