"""Driving: the sensors, the car and the kind of circuits of TORCS, as pure functions."""

from envs.driving.circuits import NAMES as CIRCUIT_NAMES
from envs.driving.circuits import random_circuit
from envs.driving.drive import Drive
from envs.driving.driver import scripted_driver
from envs.driving.env import Driving
from envs.driving.loaders import load_track
from envs.driving.tracks import Arc, Segment, Straight, Track, from_segments, parse_segments

__all__ = [
    "CIRCUIT_NAMES",
    "Arc",
    "Drive",
    "Driving",
    "Segment",
    "Straight",
    "Track",
    "from_segments",
    "load_track",
    "parse_segments",
    "random_circuit",
    "scripted_driver",
]
