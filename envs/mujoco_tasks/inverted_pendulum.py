"""InvertedPendulum: a pole on a cart, to be kept upright."""

import dataclasses

from envs.mujoco_tasks.task import MujocoTask, uniform_offset

MAX_ANGLE = 0.2  # rad


@dataclasses.dataclass(frozen=True, eq=False)
class InvertedPendulum(MujocoTask):
    """Gymnasium's InvertedPendulum-v5.

    action       [1] force on the cart; ±1 is ±3 of control
    observation  [4] x of the cart (m), angle of the pole (rad), and their velocities
    reward       1 until the end
    start        all positions and velocities uniform within ±reset_noise_scale
    end          the pole leans by more than 0.2 rad, or a state is not finite
    """

    published_k = 3.0
    xml_file: str = "inverted_pendulum.xml"
    frame_skip: int = 2
    reset_noise_scale: float = 0.01

    def start_offset(self, key):
        return uniform_offset(key, self.reset_noise_scale, self.model.nq, self.model.nv)

    def observation(self, xp, physics):
        return xp.concatenate([physics.qpos, physics.qvel], -1)

    def reward(self, xp, anchor, physics, control):
        survive = 1.0 - self.terminated(xp, physics)
        return survive, {"reward_survive": survive}

    def terminated(self, xp, physics):
        finite = xp.isfinite(self.observation(xp, physics)).all(-1)
        return ~finite | (xp.abs(physics.qpos[..., 1]) > MAX_ANGLE)
