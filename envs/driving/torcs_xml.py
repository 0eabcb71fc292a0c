"""Tracks from TORCS's v4 track files, which a user of TORCS has: this project ships none."""

import xml.parsers.expat
from pathlib import Path

import numpy as np

from envs.driving.tracks import LONGEST, Arc, Segment, Straight, Track, from_segments

# The first unit is what a number without one is in.
METRES = {"m": 1.0, "ft": 0.304801, "feet": 0.304801, "km": 1000.0, "mm": 0.001}
DEGREES = {"rad": 180 / np.pi, "deg": 1.0}
MOST_PIECES = 10_000
"""Of a spiral."""
SURFACES = {  # friction and rolling resistance, by the beginning of a surface's name
    "asphalt": (1.2, 0.001),
    "asphalt2": (1.25, 0.001),
    "asphalt2-lines": (1.4, 0.0012),
    "road1": (1.1, 0.002),
    "concrete": (0.8, 0.0035),
    "dirt": (0.9, 0.006),
    "sand": (0.6, 0.1),
    "grass": (0.4, 0.01),
}


def read_torcs_xml(path: Path) -> Track:
    """The track of a file: its main segments, width and surface, flat and without its sides.

    Raises:
      ValueError: if it is malformed, with the line, or does not close.
    """
    main = _sections(path).section("Main Track")
    listed = main.section("Track Segments")
    step = main.number("profil steps length", METRES, 0.0)
    segments = [_segment(section, step) for section in listed.sections]
    if not segments:
        raise listed.error("has no segments")
    surface = main.text("surface", "asphalt")
    begins = max((s for s in SURFACES if surface.startswith(s)), key=len, default="asphalt")
    width = main.number("width", METRES)
    return from_segments(path.stem, segments, width, *SURFACES[begins])


def _segment(section: "_Section", step: float) -> Segment:
    """One segment of a file whose spirals have pieces of `step` m, 0 for the default."""
    kind = section.text("type")
    if kind == "str":
        return Straight(section.positive("lg", METRES, at_most=LONGEST))
    if kind not in ("lft", "rgt"):
        raise section.error(f"has the type {kind!r}, not str, lft or rgt")
    radius = section.positive("radius", METRES)
    degrees = section.positive("arc", DEGREES)
    end_radius = section.positive("end radius", METRES, radius)
    length = (radius + end_radius) / 2 * np.deg2rad(degrees)
    if length > LONGEST:
        raise section.error(f"is {length:g} m long, more than {LONGEST:g}")
    steps = round(section.number("profil steps", {}, 0.0))
    step = section.number("profil steps length", METRES, step)
    if not steps and step > 0:
        steps = int(min(length / step, MOST_PIECES)) + 1
    if not 0 <= steps <= MOST_PIECES:
        raise section.error(f"has {steps:g} profil steps, not 0 to {MOST_PIECES:,}")
    return Arc(radius, degrees if kind == "lft" else -degrees, end_radius, steps or None)


class _Section:
    """A section of a TORCS parameter file: its values with their units, and its sections."""

    def __init__(self, path: Path, name: str, line: int):
        self.path, self.name, self.line = path, name, line
        self.values: dict[str, tuple[str, str | None, int]] = {}  # value, unit, line
        self.sections: list[_Section] = []

    def error(self, what: str, line: int | None = None) -> ValueError:
        return ValueError(f"{self.path}, line {line or self.line}: section {self.name!r} {what}")

    def section(self, name: str) -> "_Section":
        for section in self.sections:
            if section.name == name:
                return section
        raise self.error(f"has no section {name!r}")

    def text(self, name: str, default: str | None = None) -> str:
        if name in self.values:
            return self.values[name][0]
        if default is None:
            raise self.error(f"has no {name!r}")
        return default

    def number(self, name: str, units: dict[str, float], default: float | None = None) -> float:
        """The value times its unit; one without a unit is taken in the first of `units`."""
        if name not in self.values and default is not None:
            return default
        text = self.text(name)
        _, unit, line = self.values[name]
        if unit and units and unit not in units:
            raise self.error(f"gives {name!r} in {unit!r}, not {', '.join(units)}", line)
        try:
            value = float(text)
        except ValueError:
            value = np.nan
        if not np.isfinite(value):
            raise self.error(f"gives {name!r} as {text!r}, not a number", line)
        return value * units[unit or next(iter(units))] if units else value

    def positive(
        self,
        name: str,
        units: dict[str, float],
        default: float | None = None,
        at_most: float = np.inf,
    ) -> float:
        value = self.number(name, units, default)
        if value <= 0:
            raise self.error(f"gives {name!r} as {value:g}, not above 0")
        if value > at_most:
            raise self.error(f"gives {name!r} as {value:g}, more than {at_most:g}")
        return value


def _sections(path: Path) -> _Section:
    """The sections of an XML file. Entities kept in other files are skipped, never opened."""
    parser = xml.parsers.expat.ParserCreate()
    root = _Section(path, path.stem, 1)
    stack = [root]

    def start(tag, attributes):
        line = parser.CurrentLineNumber
        if tag == "section":
            child = _Section(path, attributes.get("name", ""), line)
            stack[-1].sections.append(child)
            stack.append(child)
        elif tag in ("attnum", "attstr"):
            if not {"name", "val"} <= attributes.keys():
                raise ValueError(f"{path}, line {line}: {tag} needs a name and a val")
            value = (attributes["val"], attributes.get("unit"), line)
            stack[-1].values[attributes["name"]] = value

    def end(tag):
        if tag == "section":
            stack.pop()

    parser.StartElementHandler, parser.EndElementHandler = start, end
    try:
        parser.Parse(path.read_bytes(), True)
    except xml.parsers.expat.ExpatError as error:
        reason = xml.parsers.expat.errors.messages[error.code]
        raise ValueError(f"{path}, line {error.lineno}: {reason}") from None
    return root
