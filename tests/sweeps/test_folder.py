"""The folder of a sweep is its grid, as data."""

import json

import pytest

from mapg_jax.runs.folder import FORMAT
from mapg_jax.sweeps.folder import SweepFolder


def test_a_sweep_folder_is_its_grid(tmp_path):
    values = {"hidden": ((8, 8), (16, 16)), "env_options": ((), ("g=9.81",)), "seed": (0, 1)}
    folder = SweepFolder(tmp_path / "s", "smoke", values, group=2, workers=1, keep_replay=True)
    folder.create()
    assert SweepFolder.is_one(folder.path)
    assert SweepFolder.open(folder.path) == folder
    assert len(folder.runs()) == 8
    (folder.path / "sweep.json").write_text("{}")
    with pytest.raises(ValueError, match=r"sweep\.json is damaged"):
        SweepFolder.open(folder.path)


def test_a_sweep_folder_of_another_format_is_refused_in_one_line(tmp_path):
    folder = SweepFolder(tmp_path / "s", "smoke", {"seed": (0, 1)})
    folder.create()
    file = folder.path / "sweep.json"
    record = json.loads(file.read_text())
    for found in (1, FORMAT + 1):
        file.write_text(json.dumps({**record, "format": found}))
        message = f"is of format {found}, and this version reads {FORMAT}"
        with pytest.raises(ValueError, match=message) as error:
            SweepFolder.open(folder.path)
        assert "\n" not in str(error.value)


@pytest.mark.parametrize(
    "damage",
    [
        {"launcher": "foo"},
        {"workers": "x"},
        {"workers": 0},
        {"group": "some"},
        {"launcher_options": [1]},
        {"values": {"seed": 5}},
    ],
)
def test_a_damaged_sweep_folder_is_named(damage, tmp_path):
    SweepFolder(tmp_path / "s", "smoke", {"seed": (0, 1)}).create()
    file = tmp_path / "s" / "sweep.json"
    file.write_text(json.dumps({**json.loads(file.read_text()), **damage}))
    with pytest.raises(ValueError, match=r"sweep\.json is damaged: "):
        SweepFolder.open(tmp_path / "s")
