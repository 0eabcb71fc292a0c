"""Tracks from a user's files; what is wrong in one is named with its line."""

import numpy as np
import pytest

from envs.driving import Track, from_segments, load_track, parse_segments

HEADER = """<?xml version="1.0" encoding="UTF-8"?>
<!DOCTYPE params SYSTEM "../../libs/params.dtd" [
<!ENTITY default-surfaces SYSTEM "../../../data/tracks/surfaces.xml">
]>
<params name="park" type="trackdef">
  <section name="Surfaces">&default-surfaces;</section>
  <section name="Main Track">
    <attnum name="width" unit="m" val="12.0"/>
    <attstr name="surface" val="road1"/>
    <attnum name="profil steps length" unit="m" val="5"/>
    <section name="Left Side"><attnum name="start width" val="4"/></section>
    <section name="Track Segments">
"""
FOOTER = "    </section>\n  </section>\n</params>\n"
PARK = """
<section name="s1"><attstr name="type" val="str"/><attnum name="lg" unit="m" val="120"/></section>
<section name="c1"><attstr name="type" val="lft"/><attnum name="radius" unit="m" val="50"/>
  <attnum name="arc" unit="deg" val="180"/></section>
<section name="s2"><attstr name="type" val="str"/><attnum name="lg" unit="ft" val="393.6994"/>
</section>
<section name="c2"><attstr name="type" val="lft"/><attnum name="radius" unit="m" val="50"/>
  <attnum name="arc" unit="rad" val="3.14159265"/></section>
"""


def write(folder, text, name="park.xml"):
    path = folder / name
    path.write_text(text)
    return path


def test_a_torcs_file_is_its_segments(tmp_path):
    track = load_track(str(write(tmp_path, HEADER + PARK + FOOTER)))
    expected = from_segments("park", parse_segments("S120 L50/180 S120 L50/180"), 12.0)
    # The feet make 120 m less 0.03 mm, and the gap that leaves is spread over the lap.
    for name in ("x", "y", "heading", "s", "width"):
        np.testing.assert_allclose(getattr(track, name), getattr(expected, name), atol=1e-3)
    assert track.name == "park" and track.friction == 1.1


@pytest.mark.parametrize("steps", ["", '<attnum name="profil steps" val="8"/>'])
def test_spirals_have_the_steps_of_the_file(tmp_path, steps):
    """Or pieces of its step length: 47 m in steps of 5 m make 10."""
    spiral = """
    <section name="in"><attstr name="type" val="rgt"/><attnum name="radius" val="40"/>
      <attnum name="end radius" val="20"/><attnum name="arc" unit="deg" val="90"/>STEPS</section>
    <section name="out"><attstr name="type" val="rgt"/><attnum name="radius" val="20"/>
      <attnum name="end radius" val="40"/><attnum name="arc" unit="deg" val="90"/>STEPS</section>"""
    spiral = 2 * spiral.replace("STEPS", steps)
    track = load_track(write(tmp_path, HEADER + spiral + FOOTER))
    bend = np.diff(track.heading)
    radii = np.unique((-np.diff(track.s) / bend).round(4))
    np.testing.assert_allclose(radii, np.linspace(20, 40, 8 if steps else 10), rtol=1e-4)


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("</section>\n</params>", "</params>", r"park\.xml, line 21: mismatched tag"),
        ('"Main Track"', '"Side Track"', r"line 1: section 'park' has no section 'Main Track'"),
        ('val="lft"', 'val="left"', r"line 14: section 'c1' has the type 'left', not str"),
        ('val="120"', 'val="long"', r"line 13: section 's1' gives 'lg' as 'long', not a number"),
        ('val="120"', 'val="inf"', r"line 13: section 's1' gives 'lg' as 'inf', not a number"),
        ('val="120"', 'val="1e9"', r"line 13: section 's1' gives 'lg' as 1e\+09, more than 1"),
        ('unit="m" val="50"', 'val="1e9"', r"line 14: section 'c1' is 3\.1\d*e\+09 m long, more"),
        (
            'name="radius" unit',
            'name="profil steps" val="1e9"/><attnum name="radius" unit',
            r"line 14: section 'c1' has 1e\+09 profil steps, not 0 to 10,000",
        ),
        ('val="120"', 'val="-120"', r"line 13: section 's1' gives 'lg' as -120, not above 0"),
        ('unit="m" val="50"', 'unit="yd" val="50"', r"line 14: .* gives 'radius' in 'yd', not m"),
        ('name="radius"', 'name="r"', r"line 14: section 'c1' has no 'radius'"),
        ('unit="m" val="120"', 'unit="m"', r"line 13: attnum needs a name and a val"),
        ('val="12.0"', 'val="1.0"', r"'park' is 1\.00 m wide .* narrower than the car"),
        ('val="180"', 'val="170"', r"'park' does not close"),
    ],
)
def test_bad_torcs_files_are_named_with_the_line(tmp_path, old, new, message):
    text = HEADER + PARK.lstrip() + FOOTER
    assert old in text
    with pytest.raises(ValueError, match=message):
        load_track(write(tmp_path, text.replace(old, new, 1)))


def test_a_torcs_file_without_segments_is_refused(tmp_path):
    with pytest.raises(ValueError, match="section 'Track Segments' has no segments"):
        load_track(write(tmp_path, HEADER + FOOTER))


def csv_rows(n=120, noise=0.0):
    """An ellipse of 200 by 120 m, anticlockwise, 5 m to its right and 7 m to its left."""
    t = np.linspace(0, 2 * np.pi, n, endpoint=False)
    points = np.stack([200 * np.cos(t), 120 * np.sin(t)], -1)
    points += noise * np.random.default_rng(0).standard_normal(points.shape)
    return [f"{x:.4f},{y:.4f},5.0,7.0" for x, y in points]


def write_csv(folder, rows, header="# x_m,y_m,w_tr_right_m,w_tr_left_m"):
    return write(folder, "\n".join([header, *rows]) + "\n", "oval.csv")


@pytest.mark.parametrize("noise", [0.0, 0.1])  # m: what maps of real tracks have
def test_a_csv_is_smoothed_to_its_curve(tmp_path, noise):
    """Edges within 0.4 m of the ellipse's, first point first.

    Smoothing cuts the sharpest bend (72 m) by 0.11 m and chords of 8.5 m by 0.08 m on the mean;
    three standard errors of the smoothed noise are 0.2 m.
    """
    track = load_track(write_csv(tmp_path, csv_rows(noise=noise)))
    t = np.linspace(0, 2 * np.pi, 20_000)
    curve = np.stack([200 * np.cos(t), 120 * np.sin(t)], -1)
    for edge, distance in ((track.left, 7.0), (track.right, 5.0)):
        apart = np.linalg.norm(edge[:, None] - curve, axis=-1).min(-1)
        np.testing.assert_allclose(apart, distance, atol=0.4)
    assert track.length == pytest.approx(
        np.linalg.norm(np.diff(curve, axis=0), axis=-1).sum(), rel=0.01
    )
    assert track.turn == 2 * np.pi
    assert np.hypot(track.x[0] - 199, track.y[0]) < 0.5  # the middle lies 1 m to the left
    curvature = np.abs(np.diff(track.heading) / np.diff(track.s))
    assert curvature.max() < 2 * 200 / 120**2  # not that of the noise, some 0.2 / m


def test_a_hairpin_of_a_csv_stays_wider_than_its_road(tmp_path):
    """Radius 10 m, 15 m wide, points 5 m apart: a spline through them would turn within 7.5 m."""
    park = from_segments("park", parse_segments("S150 L10/180 S300 L10/180 S150"), 15.0)
    at = np.arange(0, park.length, 5.0)
    s = np.append(park.s, park.length)
    x, y = (np.interp(at, s, np.append(v, v[0])) for v in (park.x, park.y))
    rows = [f"{x:.4f},{y:.4f},7.5,7.5" for x, y in zip(x, y, strict=True)]
    track = load_track(write_csv(tmp_path, rows))
    curvature = np.diff(track.heading) / np.diff(track.s)
    assert 8.5 < 1 / curvature.max() < 10


def test_a_repeated_last_point_is_the_first(tmp_path):
    rows = csv_rows()
    closed = load_track(write_csv(tmp_path, [*rows, rows[0]]))
    np.testing.assert_array_equal(closed.x, load_track(write_csv(tmp_path, rows)).x)


def test_a_csv_may_name_its_columns_without_a_comment_sign(tmp_path):
    assert load_track(write_csv(tmp_path, csv_rows(), "x_m,y_m,w_tr_right_m,w_tr_left_m"))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda rows: [*rows[:3], "1.0,2.0,oops,3", *rows[3:]], r"oval\.csv, line 5: '1\.0,2\.0,o"),
        (lambda rows: [*rows[:3], "1.0,2.0,3", *rows[3:]], r"line 5: '1\.0,2\.0,3' is not x_m,"),
        (lambda rows: [*rows[:3], "1,2,nan,4", *rows[3:]], r"line 5: '1,2,nan,4' is not x_m,"),
        (lambda rows: rows[:5], r"a track needs at least 8 points, got 5"),
        (lambda rows: rows[:60], r"the track does not close, its last point lies 39\d\.\d m"),
        (lambda rows: [rows[0], *rows], r"point 1 is repeated"),
        (lambda rows: [r.replace("5.0,7.0", "0.5,0.7") for r in rows], r"narrower than the car"),
    ],
)
def test_bad_csv_files_are_named_with_the_line(tmp_path, change, message):
    with pytest.raises(ValueError, match=message):
        load_track(write_csv(tmp_path, change(csv_rows())))


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("speedwy", r"unknown track 'speedwy'; known are speedway, road, town, mountain, eight"),
        ("missing.xml", r"there is no track file missing\.xml"),
        ("random:x", r"unknown track 'random:x'"),
    ],
)
def test_unknown_tracks_are_named(name, message):
    with pytest.raises(ValueError, match=message):
        load_track(name)


def test_a_name_a_seed_or_a_track():
    assert load_track("town").name == "town"
    assert load_track("random:5").name == "random:5"
    track = load_track("road")
    assert isinstance(track, Track) and load_track(track) is track


def test_what_is_too_large_to_be_a_track_is_refused(tmp_path):
    far = "\n".join(f"{1e7 * np.cos(a)},{1e7 * np.sin(a)},5,5" for a in np.linspace(0, 6, 20))
    with pytest.raises(ValueError, match=r"a lap is 6\d,\d+,\d+ m long, more than 100,000"):
        load_track(write(tmp_path, far, "far.csv"))
    with pytest.raises(ValueError, match="has more than 5,000,000 bytes: it is no track file"):
        load_track(write(tmp_path, "#" * 5_000_001, "large.csv"))
