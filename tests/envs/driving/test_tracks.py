"""Tracks: closed, as long as their segments say, and places on them found again."""

import math
import pathlib
import re

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from envs.driving import bank as banks
from envs.driving import circuits, load_track
from envs.driving.tracks import Arc, Straight, from_segments, parse_segments

SHIPPED = {name: load_track(name) for name in circuits.NAMES}


def polygon_length(track):
    step = np.diff(np.stack([track.x, track.y], -1), axis=0, append=[[track.x[0], track.y[0]]])
    return np.linalg.norm(step, axis=-1)


@pytest.mark.parametrize("name", SHIPPED)
def test_circuits_close(name):
    """The last cell is as straight and as long as the s of its ends says."""
    track = SHIPPED[name]
    chords, cells = polygon_length(track), np.diff(track.s, append=track.length)
    bends = np.diff(track.heading, append=track.heading[0] + track.turn)
    # A chord of an arc is shorter than the arc by a factor of 1 - bend² / 24 + …
    np.testing.assert_allclose(chords, cells * np.sinc(bends / 2 / np.pi), rtol=1e-9, atol=1e-9)
    assert abs(bends).max() < 0.2
    assert track.turn == pytest.approx(0 if name == "eight" else 2 * math.pi, abs=1e-9)


def test_circuits_span_what_torcs_has():
    """Of section 5.2: 2 to 7 km, 10 to 20 m wide, radii down to 12 m, 2 to 38 turns."""
    lengths = {name: track.length for name, track in SHIPPED.items()}
    assert 1900 < lengths["speedway"] < 2100 and 2900 < lengths["road"] < 3300
    assert 2400 < lengths["town"] < 2700 and 6000 < lengths["mountain"] < 7000
    tightest = {n: circuits_radii(n).min() for n in SHIPPED}
    assert tightest["speedway"] >= 60 and tightest["town"] < 12.5 and tightest["mountain"] == 20
    assert {t.width[0] for t in SHIPPED.values()} == {10, 12, 15, 16}
    assert len(circuits_radii("speedway")) == 7 and len(circuits_radii("mountain")) > 38


def circuits_radii(name):
    segments = parse_segments(circuits.CIRCUITS[name][1])
    return np.array([s.radius for s in segments if isinstance(s, Arc)])


@pytest.mark.parametrize("name", SHIPPED)
def test_only_the_figure_eight_crosses_itself(name):
    assert circuits.crossings(SHIPPED[name]).any() == (name == "eight")


def test_crossings_are_found():
    """Two edges of one leg cross two of the other: four crossings, each seen from both pieces."""
    assert circuits.crossings(SHIPPED["eight"]).sum() == 8


@pytest.mark.parametrize("seed", range(25))
def test_random_circuits_close_and_do_not_cross_themselves(seed):
    track = circuits.random_circuit(seed, length=1500 + 100 * seed, corners=6 + seed % 9)
    assert polygon_length(track).max() < 20.1
    assert track.turn == pytest.approx(2 * math.pi, abs=1e-9)
    assert not circuits.crossings(track).any()


def test_random_circuits_cross_themselves_when_asked_to_and_repeat_with_their_seed():
    for seed in range(5):
        track = circuits.random_circuit(seed, crossing=True)
        assert circuits.crossings(track).any() and abs(track.turn) < 1e-9
    first, again = (circuits.random_circuit(3) for _ in range(2))
    np.testing.assert_array_equal(first.x, again.x)
    assert not np.array_equal(first.x[:20], circuits.random_circuit(4).x[:20])


def test_lengths_are_those_of_the_segments():
    stadium = [Straight(300.0), Arc(50.0, 180.0), Straight(300.0), Arc(50.0, 180.0)]
    track = from_segments("stadium", stadium, 10.0)
    assert track.length == pytest.approx(600 + 100 * math.pi, rel=1e-12)
    radius = np.hypot(track.x - 300, track.y - 50)[(track.x > 300)]
    np.testing.assert_allclose(radius, 50, rtol=1e-12)


def test_a_spiral_has_pieces_of_even_length_and_evenly_growing_radius():
    spirals = [Arc(30.0, 90.0, 90.0, steps=4), Arc(90.0, 90.0, 30.0, steps=4)]
    track = from_segments("egg", 2 * spirals, 10.0)
    bend, cells = np.diff(track.heading), np.diff(track.s)
    quarter = track.heading[1:] < math.pi / 2 + 1e-9
    radius = (cells / bend)[quarter]
    np.testing.assert_allclose(np.unique(radius.round(6)), [30, 50, 70, 90])
    lengths = [cells[quarter][np.isclose(radius, r)].sum() for r in (30, 50, 70, 90)]
    expected = math.pi / 2 / (1 / 30 + 1 / 50 + 1 / 70 + 1 / 90)
    np.testing.assert_allclose(lengths, expected)


@pytest.mark.parametrize(
    ("segments", "width", "message"),
    [
        ("S100 L50/90", 10, r"'t' does not close: its end misses its start by 158\.\d+ m and 90"),
        ("S100 L50/180 S90 L50/180", 10, r"does not close: .* by 10\.00 m and 0\.00 degrees"),
        ("S100 L50/180 S100 L50/180", 1.5, r"is 1\.50 m wide at s = 0 m, narrower than the car"),
        ("S100 L5/180 S100 L5/180", 12, r"'t' turns tighter than half its width at s = 10\d m"),
        ("S100 L50/180 S* L50/180", 10, r"must have no or two open straights, has 1"),
        ("S100 L50/180 S* L50/180 S*", 10, r"open straights of track 't' are parallel"),
        ("S100 L90/90 S* L50/90 S* L50/180", 10, r"'t' closes only with straights of \["),
        ("S100 L50/x", 10, r"'L50/x' is no segment: S<m>"),
        ("S0 L50/360", 10, r"a straight must be longer than 0 m, got 0"),
        ("L0/360", 10, r"an arc needs radii and an angle above 0, got Arc\(radius=0"),
    ],
)
def test_bad_tracks_are_refused(segments, width, message):
    with pytest.raises(ValueError, match=message):
        from_segments("t", parse_segments(segments), width)


def places(track, s, position):
    """Where `banks.place` finds points given by s and the position across, from their cells."""
    bank = banks.make_bank([track])

    def find(s, position):
        cell, x, y, _ = banks.point(bank, 0, s)
        # Across the road along the interpolated portal, which is what `position` measures.
        start = bank.edges[bank.first[0] + cell]
        end = bank.edges[bank.first[0] + cell + 1]
        line = bank.line[bank.first[0] + cell, 1], bank.line[bank.first[0] + cell + 1, 1]
        left_x, left_y, right_x, right_y = start + (s - line[0]) / (line[1] - line[0]) * (
            end - start
        )
        x = x + position * (left_x - right_x) / 2
        y = y + position * (left_y - right_y) / 2
        return cell, banks.place(bank, 0, cell, x, y)

    return jax.jit(jax.vmap(find))(jnp.float32(s), jnp.float32(position))


@pytest.mark.parametrize("name", SHIPPED)
def test_places_are_found_again(name):
    """s to 0.2 m: within a cell it follows the portals, which turn unevenly where a bend begins."""
    track, rng = SHIPPED[name], np.random.default_rng(0)
    s, position = rng.uniform(0, track.length, 2000), rng.uniform(-1, 1, 2000)
    cell, found = places(track, s, position)
    np.testing.assert_array_equal(found.cell, cell)
    assert not np.asarray(found.crossed).any()
    np.testing.assert_allclose(found.position, position, atol=1e-3)
    np.testing.assert_allclose(found.width, track.width[0], rtol=0.02)
    np.testing.assert_allclose(found.s, s, atol=0.2)
    np.testing.assert_allclose(found.heading, np.interp(s, track.s, track.heading), atol=0.03)


@pytest.mark.parametrize("name", SHIPPED)
def test_walking_a_lap_leads_once_over_the_start_line(name):
    """In steps of 0.3 m, the most that a physics step covers, on any line across the road."""
    track = SHIPPED[name]
    bank = banks.make_bank([track])
    s = np.arange(0.1, track.length, 0.3)
    position = 0.9 * np.sin(s / 40)
    heading = np.interp(s, np.append(track.s, track.length), np.append(track.heading, track.turn))
    loop = [np.append(v, v[0]) for v in (track.x, track.y)]
    x, y = (np.interp(s, np.append(track.s, track.length), v) for v in loop)
    x -= position * track.width[0] / 2 * np.sin(heading)
    y += position * track.width[0] / 2 * np.cos(heading)

    def walk(direction):
        def step(carry, point):
            cell, crossed = carry
            place = banks.place(bank, 0, cell, *point)
            return (place.cell, crossed + place.crossed), (place.cell, place.s)

        points = np.stack([x, y], -1).astype(np.float32)[:: int(direction)]
        points = np.concatenate([points, points[:2]])
        start = banks.point(bank, 0, jnp.float32(s[:: int(direction)][0]))[0]
        (_, crossed), (cells, found) = jax.jit(
            lambda start, points: jax.lax.scan(step, (start, jnp.int32(0)), points)
        )(start, points)
        return int(crossed), np.asarray(cells), np.asarray(found)

    for direction in (1, -1):
        crossed, cells, found = walk(direction)
        assert crossed == direction
        along = np.append(s[::direction], s[::direction][:2])
        apart = (found - along + track.length / 2) % track.length - track.length / 2
        assert np.abs(apart).max() < 3.0  # m, towards an edge of a tight bend
        assert set(cells) == set(range(len(track.s)))


def test_the_example_of_the_docs_is_a_track():
    docs = pathlib.Path(__file__).parents[3] / "docs" / "driving.md"
    pattern = r"```python\n(from envs.driving import from_segments.*?)```"
    (example,) = re.findall(pattern, docs.read_text(), re.S)
    names: dict = {}
    exec(example, names)
    assert names["track"].name == "mine" and not circuits.crossings(names["track"]).any()
