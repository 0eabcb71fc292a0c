"""The driving environment: a car on a track of a bank."""

import functools
import math
from collections.abc import Collection, Sequence
from pathlib import Path
from typing import Any, cast

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float32, Int

from envs.base import Action, Env, State
from envs.driving import bank as banks
from envs.driving import sensors as sensing
from envs.driving.bank import Place
from envs.driving.drawing import animate, draw_line, picture_of_car
from envs.driving.drive import Drive, metrics
from envs.driving.loaders import load_track
from envs.driving.powertrain import engine_speed
from envs.driving.rewards import REWARDS, Motion, progress_kmh
from envs.driving.setup import Setup, drawn
from envs.driving.tracks import Track
from envs.driving.vehicle import WHEEL_X, WHEEL_Y, at_rest, step_car, wrap
from envs.frames import Painter, Picture
from envs.recording import Episode, Player
from envs.scored import ScoredMetric

GRASS_FRICTION, GRASS_ROLLING = 0.4, 0.01
LONGEST_PHYSICS_STEP = 0.005  # s; see `vehicle.step_car`
LAP_TIMES_KEPT = 10
"""Where no `max_laps` says how many there can be."""
MOST_LAPS = 1_000
"""Of `max_laps`: each car carries the time of every lap."""


class Driving(Env):
    """TORCS's sensors and car on closed tracks.

    | | |
    |---|---|
    | action [3] in [-1, 1] | steer (+1 full left), accelerator and brake: see `controls` |
    | observation [29 + K] | angle, 19 range finders, trackPos, speeds, wheels, rpm: \
      `sensors.observe`; the curvature at K distances ahead |
    | reward | by name: `rewards.REWARDS` |
    | start | at rest on the centre line, at s = 0 or anywhere |
    | end | off the track, backwards, no progress, or so many laps |

    An action that is not a number counts as 0.

    Args:
      track: a name, a file (.xml, .csv), a `Track`, or several of them: a bank, of which `reset`
        takes one by its index or draws one.
      control_hz: control steps a second.
      reward: of `rewards.REWARDS`.
      sensors: "snakeoil" or "scr", the angles of the range finders.
      start: "line" or "anywhere".
      off_track_end: |trackPos| beyond which an episode ends; None for never.
      backwards_end: degrees between car and track beyond which it ends; None for never.
      slow_end: km/h along the track below which, for `slow_time` s on end, it ends; None for never.
      slow_time: s.
      max_laps: laps after which it ends; None for never.
      off_track_penalty: taken from the reward of each control step that ends off the track.
      lookahead: m ahead along the centre line, each of which adds the curvature there to the
        observation, in units of 0.1/m, to the left positive.
      mass, power, brakes, grip, drag: factors of the car's own; see `setup.Setup`.
      randomize: each episode draws these five factors uniformly within this share of them.
      physics_dt: s, a whole fraction of the control step, at most 5 ms.
    """

    action_high = np.ones(3, np.float32)
    scored_metrics = (
        ScoredMetric("distance_mean", "distance", "distance, m"),
        ScoredMetric("laps_mean", "laps", "laps"),
        ScoredMetric("lap_share", "laps", "episodes with a lap", lambda laps: np.mean(laps >= 1)),
    )

    def __init__(
        self,
        track: str | Path | Track | Sequence[str | Path | Track] = "speedway",
        control_hz: float = 50.0,
        reward: str = "progress",
        sensors: str = "snakeoil",
        start: str = "line",
        off_track_end: float | None = 1.0,
        backwards_end: float | None = 90.0,
        slow_end: float | None = 5.0,
        slow_time: float = 10.0,
        physics_dt: float = 0.0025,
        max_laps: int | None = None,
        off_track_penalty: float = 0.0,
        lookahead: tuple[float, ...] = (),
        mass: float = 1.0,
        power: float = 1.0,
        brakes: float = 1.0,
        grip: float = 1.0,
        drag: float = 1.0,
        randomize: float = 0.0,
    ):
        self._substeps = _substeps(control_hz, physics_dt)
        self._dt = 1 / control_hz
        self._physics_dt = physics_dt
        self._reward = REWARDS[_known("reward", reward, REWARDS)]
        self.ray_angles = sensing.RAY_ANGLES[_known("sensors", sensors, sensing.RAY_ANGLES)]
        self._anywhere = _known("start", start, ("line", "anywhere")) == "anywhere"
        self._off_track_end = _limit("off_track_end", off_track_end)
        self._backwards_end = math.radians(_limit("backwards_end", backwards_end))
        self._slow_end = -math.inf if slow_end is None else _limit("slow_end", slow_end)
        self._slow_steps = math.ceil(_limit("slow_time", slow_time) * control_hz)
        self._max_laps = _limit("max_laps", max_laps)
        if MOST_LAPS < self._max_laps < math.inf:
            raise ValueError(f"max_laps must be at most {MOST_LAPS}, got {max_laps}")
        self._lap_times = LAP_TIMES_KEPT if max_laps is None else max_laps
        if not (math.isfinite(off_track_penalty) and off_track_penalty >= 0):
            raise ValueError(f"off_track_penalty must be at least 0, got {off_track_penalty}")
        self._off_track_penalty = off_track_penalty
        if not all(0 <= ahead < math.inf for ahead in lookahead):
            raise ValueError(f"lookahead must be distances of at least 0 m, got {lookahead}")
        self._lookahead = np.array(lookahead, np.float32)
        self._setup = Setup(mass, power, brakes, grip, drag)
        for name, factor in self._setup._asdict().items():
            if not 0.1 <= factor <= 10:
                raise ValueError(f"{name} must be a factor from 0.1 to 10, got {factor}")
        if not 0 <= randomize < 1:
            raise ValueError(f"randomize must be a share in [0, 1), got {randomize}")
        self._randomize = randomize
        alone = isinstance(track, str) or not isinstance(track, Sequence)
        several: Any = (track,) if alone else track
        self.tracks = tuple(map(load_track, several))
        if not self.tracks:
            raise ValueError("track must name at least one track, got none")
        self.bank = banks.make_bank(self.tracks)
        self.observation_bounds = sensing.bounds(self._farthest_out(), len(lookahead))

    @property
    def observation_size(self) -> int:
        return sensing.SIZE + len(self._lookahead)

    @property
    def action_size(self) -> int:
        return 3

    @property
    def backend(self) -> str:
        return "jax"

    @property
    def dt(self) -> float:
        """s, of a control step."""
        return self._dt

    def reset(self, rng: jax.Array, track: int | Int[Array, ""] | None = None) -> State:
        """At rest on the centre line.

        Args:
          rng: key of the track, where none is given, and of the place, where it is drawn.
          track: index into `tracks`.
        """
        track_key, start_key = jax.random.split(rng)
        setup = None
        if self._randomize:
            setup = drawn(jax.random.fold_in(rng, 2), self._setup, self._randomize)
        if track is None:
            track = jax.random.randint(track_key, (), 0, len(self.tracks))
        elif isinstance(track, int) and not 0 <= track < len(self.tracks):
            raise ValueError(f"track must be an index below {len(self.tracks)}, got {track}")
        track = jnp.asarray(track, jnp.int32)
        s = jnp.zeros(())
        if self._anywhere:
            s = jax.random.uniform(start_key) * self.bank.length[track]
        cell, x, y, heading = banks.point(self.bank, track, s)
        none, zero = jnp.zeros((), jnp.int32), jnp.zeros(())
        drive = Drive(
            car=at_rest(x, y, wrap(heading)),
            track=track,
            cell=cell,
            crossings=none,
            start=s,
            distance=zero,
            steps=none,
            off_steps=none,
            slow_steps=none,
            laps=none,
            lap_began=zero,
            last_lap=zero,
            lap_times=jnp.zeros(self._lap_times),
            setup=setup,
        )
        place = banks.place(self.bank, track, cell, x, y)
        return State(cast(Any, drive), self._observe(drive, place), zero, zero, metrics(drive), {})

    def step(self, state: State, action: Action) -> State:
        drive = self._move(cast(Drive, state.pipeline_state), *controls(self.clipped(action)))
        place = banks.place(self.bank, drive.track, drive.cell, drive.x, drive.y)
        forward, _ = drive.car.body_velocity
        motion = Motion(forward, wrap(place.heading - drive.heading), place.position)
        drive = self._count(drive, place, motion)
        return state.replace(
            pipeline_state=drive,
            obs=self._observe(drive, place),
            reward=self._rewarded(motion),
            done=self._ended(drive, motion).astype(jnp.float32),
            metrics={**state.metrics, **metrics(drive)},
        )

    def render(self, episodes: Sequence[Episode], player: Player, folder: Path) -> list[Path]:
        """The line on the track as drive.png, and an animation for a browser as drive.html."""
        states: Drive = episodes[0].states
        track = self.tracks[int(states.track[0])]
        positions = np.stack([states.x, states.y], -1)
        picture, animation = folder / "drive.png", folder / "drive.html"
        draw_line(track, positions, states.speed, picture)
        animate(track, positions, states.heading, states.speed, self.dt, animation)
        return [picture, animation]

    def painter(self, width: int, height: int) -> Painter:
        """The road about the car, from above."""

        def paint(drive: Drive) -> Picture:
            return picture_of_car(
                self.tracks[int(drive.track)], float(drive.x), float(drive.y),
                float(drive.heading), width, height,
            )  # fmt: skip

        return paint

    def _rewarded(self, motion: Motion) -> jax.Array:
        off_track = jnp.abs(motion.position) > 1
        return self._reward(motion) - jnp.where(off_track, self._off_track_penalty, 0.0)

    def _move(self, drive: Drive, steer, accelerator, brake) -> Drive:
        """The car after the physics steps of one control step."""
        bank, track = self.bank, drive.track
        setup = self._setup if drive.setup is None else drive.setup

        def substep(_, carry):
            car, cell, crossings = carry
            place = banks.place(bank, track, cell, car.x, car.y)
            turned = car.heading - place.heading
            to_left = WHEEL_X * jnp.sin(turned) + WHEEL_Y * jnp.cos(turned)
            on_road = jnp.abs(place.position + 2 / place.width * to_left) <= 1
            friction = jnp.where(on_road, bank.friction[track], GRASS_FRICTION)
            rolling = jnp.where(on_road, bank.rolling_resistance[track], GRASS_ROLLING)
            car = step_car(
                car, steer, accelerator, brake, friction, rolling, self._physics_dt, setup
            )
            return car, place.cell, crossings + place.crossed

        carry = (drive.car, drive.cell, drive.crossings)
        car, cell, crossings = jax.lax.fori_loop(0, self._substeps, substep, carry)
        return drive.replace(car=car, cell=cell, crossings=crossings)

    def _count(self, drive: Drive, place: Place, motion: Motion) -> Drive:
        """Distance, laps and times at the end of a control step."""
        length = self.bank.length[drive.track]
        crossings = drive.crossings + place.crossed
        distance = crossings * length + place.s - drive.start
        steps = drive.steps + 1

        laps = jnp.maximum(drive.laps, jnp.floor(distance / length).astype(jnp.int32))
        too_far = (distance - laps * length) / jnp.maximum(distance - drive.distance, 1e-3)
        lap_ended = (steps - jnp.clip(too_far, 0.0, 1.0)) * self._dt
        finished = laps > drive.laps
        slow = progress_kmh(motion) < self._slow_end
        last_lap = jnp.where(finished, lap_ended - drive.lap_began, drive.last_lap)
        # Without the barrier XLA on a CPU computes all that leads to a lap anew for each of them.
        laps, last_lap, finished = jax.lax.optimization_barrier((laps, last_lap, finished))
        this_lap = finished & (np.arange(1, self._lap_times + 1) == laps)
        return drive.replace(
            cell=place.cell,
            crossings=crossings,
            distance=distance,
            steps=steps,
            off_steps=drive.off_steps + (jnp.abs(motion.position) > 1),
            slow_steps=jnp.where(slow, drive.slow_steps + 1, 0),
            laps=laps,
            lap_began=jnp.where(finished, lap_ended, drive.lap_began),
            last_lap=last_lap,
            lap_times=jnp.where(this_lap, last_lap, drive.lap_times),
        )

    def _ended(self, drive: Drive, motion: Motion) -> jax.Array:
        off_track = jnp.abs(motion.position) > self._off_track_end
        backwards = jnp.abs(motion.angle) > self._backwards_end
        slow, arrived = drive.slow_steps >= self._slow_steps, drive.laps >= self._max_laps
        return off_track | backwards | slow | arrived

    def _observe(self, drive: Drive, place: Place) -> jax.Array:
        car = drive.car
        rays = sensing.range_finders(
            self.bank, drive.track, place.cell, car.x, car.y, car.heading, self.ray_angles
        )
        sensed = sensing.observe(car, place, rays, engine_speed(car.wheel_speed, car.gear))
        if not self._lookahead.size:
            return sensed
        curvature = jax.vmap(functools.partial(banks.curvature, self.bank, drive.track))
        ahead = curvature(place.s + self._lookahead)
        return jnp.concatenate([sensed, sensing.CURVATURE_SCALE * ahead])

    def _farthest_out(self) -> float:
        """The largest |trackPos| that is observed: one control step beyond the end, if there is."""
        half_width = min(np.linalg.norm(t.left - t.right, axis=-1).min() for t in self.tracks) / 2
        fastest = sensing.TOP_SPEED * self._dt
        return self._off_track_end + fastest / half_width


def controls(
    action: Float32[Array, "3"],
) -> tuple[Float32[Array, ""], Float32[Array, ""], Float32[Array, ""]]:
    """Steer in [-1, 1], accelerator and brake in [0, 1], of an action in [-1, 1]^3.

    The brake acts on its positive half alone: the zeros of a fresh actor are half throttle and no
    brake, and the car moves off.
    """
    action = jnp.nan_to_num(action)
    return action[0], (action[1] + 1) / 2, jnp.maximum(action[2], 0.0)


def _substeps(control_hz: float, physics_dt: float) -> int:
    if not (control_hz > 0 and 0 < physics_dt <= LONGEST_PHYSICS_STEP):
        raise ValueError(
            f"control_hz must be above 0 and physics_dt in (0, {LONGEST_PHYSICS_STEP}] s, "
            f"got {control_hz} and {physics_dt}"
        )
    substeps = round(1 / (control_hz * physics_dt))
    if abs(substeps * control_hz * physics_dt - 1) > 1e-6:
        raise ValueError(
            f"a control step of 1/{control_hz:g} s is not a whole number of physics steps of "
            f"{physics_dt:g} s"
        )
    return substeps


def _limit(what: str, value: float | None) -> float:
    """The value, or infinity for None."""
    if value is not None and not value > 0:
        raise ValueError(f"{what} must be above 0 or None, got {value}")
    return math.inf if value is None else value


def _known(what: str, name: str, names: Collection[str]) -> str:
    if name not in names:
        raise ValueError(f"unknown {what} {name!r}; known are {', '.join(names)}")
    return name
