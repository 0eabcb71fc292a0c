"""The command, called as a user does."""

import sys

import pytest

from mapg_jax.cli.main import main


@pytest.fixture
def mapg(monkeypatch, capfd, tmp_path):
    """mapg(*arguments) → exit status, standard output, standard error; in an empty folder."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("NPROC", "1")  # which `main` would set for good
    monkeypatch.setenv("COLUMNS", "200")

    def run(*arguments):
        monkeypatch.setattr(sys, "argv", ["mapg", *map(str, arguments)])
        capfd.readouterr()
        try:
            main()
            status = 0
        except SystemExit as stop:
            status = stop.code
        return status, *capfd.readouterr()

    return run


@pytest.fixture
def contents(tmp_path):
    """() → every path below the folder that `mapg` is called in, and what the files hold."""
    return lambda: {path: path.is_file() and path.read_bytes() for path in tmp_path.rglob("*")}
