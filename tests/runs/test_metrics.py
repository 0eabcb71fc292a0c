"""metrics.csv is exact and can be cut back; TensorBoard says the same."""

import contextlib
import math
import struct

import numpy as np
import pytest
from tensorboardX.proto.event_pb2 import Event

from mapg_jax.runs.metrics import MetricsFile, cut_metrics, read_metrics

ROWS = [
    {"env_steps": steps, "return_mean": float(np.float32(0.1) * steps), "seconds": math.pi}
    for steps in (100, 200, 300)
]


def write(path, rows=ROWS):
    with contextlib.closing(MetricsFile(path)) as metrics:
        for row in rows:
            metrics.write(row)


def scalars(folder):
    """{(name, step): value} of TensorBoard's files: length, checksum, event, checksum."""
    found = {}
    for path in folder.glob("events.*"):
        data = path.read_bytes()
        while data:
            (length,) = struct.unpack("<Q", data[:8])
            event, data = Event.FromString(data[12 : 12 + length]), data[16 + length :]
            found |= {(value.tag, event.step): value.simple_value for value in event.summary.value}
    return found


def test_rows_read_back_as_float32(tmp_path):
    path = tmp_path / "metrics.csv"
    write(path)
    assert path.read_text().splitlines()[0] == "env_steps,return_mean,seconds"
    for row, expected in zip(read_metrics(path), ROWS, strict=True):
        assert row["env_steps"] == expected["env_steps"]
        for name in ("return_mean", "seconds"):
            assert np.float32(row[name]) == np.float32(expected[name])


def test_no_file_has_no_rows(tmp_path):
    assert read_metrics(tmp_path / "metrics.csv") == []
    cut_metrics(tmp_path / "metrics.csv", 100)
    assert not list(tmp_path.iterdir())


def test_cutting_back_keeps_the_rows_up_to_the_checkpoint(tmp_path):
    path = tmp_path / "metrics.csv"
    write(path)
    whole = path.read_bytes()
    cut_metrics(path, 300)
    assert path.read_bytes() == whole
    cut_metrics(path, 299)
    assert path.read_bytes() == b"".join(whole.splitlines(keepends=True)[:3])
    write(path, ROWS[2:])
    assert path.read_bytes() == whole


@pytest.mark.parametrize("cell", ["missing", "cut"])
def test_a_line_cut_short_is_dropped(cell, tmp_path):
    path = tmp_path / "metrics.csv"
    write(path)
    whole = path.read_bytes()
    path.write_bytes(whole[: whole.rindex(b",") + (0 if cell == "missing" else 2)])
    assert len(read_metrics(path)) == len(ROWS) - 1
    cut_metrics(path, 300)
    write(path, ROWS[2:])
    assert path.read_bytes() == whole


def test_a_file_without_a_whole_row_is_written_anew(tmp_path):
    path = tmp_path / "metrics.csv"
    write(path)
    whole = path.read_bytes()
    for length in (0, 10, len(whole.splitlines(keepends=True)[0])):
        path.write_bytes(whole[:length])
        cut_metrics(path, 300)
        write(path)
        assert path.read_bytes() == whole


def test_tensorboard_holds_the_same_numbers(tmp_path):
    write(tmp_path / "metrics.csv")
    found = scalars(tmp_path)
    for row in ROWS:
        for name in ("return_mean", "seconds"):
            assert found[name, row["env_steps"]] == np.float32(row[name])
    assert len(found) == 2 * len(ROWS)


def test_a_number_that_is_not_there_is_left_out_of_tensorboard(tmp_path, caplog):
    """Without a finished episode there is no training return; tensorboardX would warn of it."""
    write(tmp_path / "metrics.csv", [{"env_steps": 1, "training_return": math.nan, "q": 1.0}])
    assert scalars(tmp_path) == {("q", 1): 1.0}
    assert math.isnan(read_metrics(tmp_path / "metrics.csv")[0]["training_return"])
    assert not caplog.records
