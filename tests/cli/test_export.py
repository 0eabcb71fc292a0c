"""mapg export: wrong input is one line, and nothing is written."""

import sys

import pytest


@pytest.mark.parametrize(
    ("flags", "message"),
    [
        ("export nowhere", "there is no run folder nowhere"),
        ("export {run} --out here/policy", "there is no folder here for policy"),
        ("export {run} --out {run}/config.json", "config.json exists already"),
        ("export {run} --format tar", "invalid choice: 'tar'"),
    ],
)
def test_wrong_input_is_one_line(flags, message, mapg, contents, finished_run):
    status, out, err = mapg(*flags.format(run=finished_run.path).split())
    assert (status, out) == (2, "") and message in err and err.count("\n") == 1
    assert not contents()


def test_what_is_not_installed_is_named(mapg, contents, finished_run, monkeypatch):
    monkeypatch.setitem(sys.modules, "safetensors", None)
    status, _, err = mapg("export", str(finished_run.path), "--format", "safetensors")
    assert status == 2 and "pip install 'mapg-jax[export]'" in err
    assert not contents()
