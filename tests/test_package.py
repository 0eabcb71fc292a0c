"""The wheel, installed where nothing of the project is, beside packages that have its names."""

import os
import pathlib
import re
import subprocess
import sys
import tomllib
import venv

import pytest

ROOT = pathlib.Path(__file__).parent.parent
SWEEP = (
    "sweep --preset smoke --env pendulum --heads 1 --environments 4 --replay-size 200 "
    "--batch-size 8 --hidden 8,8 --steps 400 --evaluate-every 200 --final-episodes 3 --out swept"
)


def run(command, folder, **environment):
    """A command in a folder, without what this process was told of Python's path."""
    inherited = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}
    return subprocess.run(
        [*map(str, command)],
        cwd=folder,
        env={**inherited, **environment},
        capture_output=True,
        text=True,
    )


@pytest.fixture(scope="module")
def installed(tmp_path_factory):
    """The programs of an environment that has the wheel, and our dependencies behind it."""
    root = tmp_path_factory.mktemp("package")
    pip = [sys.executable, "-m", "pip"]
    quiet = ["--quiet", "--no-deps", "--no-index", "--disable-pip-version-check"]
    build = [*pip, "wheel", *quiet, "--no-build-isolation", "--wheel-dir", root, ROOT]
    done = run(build, root)
    assert done.returncode == 0, done.stderr
    (wheel,) = root.glob("*.whl")

    venv.create(root / "venv", symlinks=True)
    python = root / "venv" / "bin" / "python"
    done = run([*pip, "--python", python, "install", *quiet, wheel], root)
    assert done.returncode == 0, done.stderr
    (packages,) = (root / "venv").glob("lib/python*/site-packages")
    # What is found through this file comes last, and its own .pth files are not read: an editable
    # installation of the project stays out.
    behind = [path for path in sys.path if path.endswith(("site-packages", "dist-packages"))]
    (packages / "dependencies.pth").write_text("\n".join(behind))
    return python.parent


def foreign(folder: pathlib.Path, name: str) -> pathlib.Path:
    """A package of somebody else."""
    package = folder / name
    package.mkdir(parents=True)
    (package / "__init__.py").write_text("raise RuntimeError('imported')\n")
    return package


def test_the_badges_of_the_readme_are_true():
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    versions = [
        name.rpartition(" ")[2] for name in project["classifiers"] if ":: Python :: 3." in name
    ]
    jax = [re.search(r"jax>=(\d+\.\d+)", line) for line in project["dependencies"]]
    shown = {
        "python": " | ".join(versions),
        "jax": " | ".join(sorted(found[1] for found in jax if found)),
        "licence": project["license"],
    }
    for name, text in shown.items():
        assert f": {text}</title>" in (ROOT / f"docs/badges/{name}.svg").read_text()


def test_a_sweep_runs_from_a_folder_with_packages_of_our_names(installed, tmp_path):
    foreign(tmp_path, "envs")
    foreign(tmp_path, "experiments")
    done = run([installed / "mapg", *SWEEP.split()], tmp_path)
    log = "".join(path.read_text() for path in tmp_path.glob("swept/*/worker.log"))
    assert done.returncode == 0, done.stderr + log
    assert len(list(tmp_path.glob("swept/*/evaluation.json"))) == 1


@pytest.mark.parametrize("name", ["envs", "experiments"])
def test_a_foreign_package_that_wins_is_named(installed, tmp_path, name):
    package = foreign(tmp_path / "theirs", name)
    done = run([installed / "mapg", "envs"], tmp_path, PYTHONPATH=str(package.parent))
    assert (done.returncode, done.stdout) == (2, "")
    (line,) = done.stderr.splitlines()
    assert line.startswith(f"mapg: {package} is imported in place of mapg-jax's own package")
    assert f"take {package.parent} off Python's path" in line


def test_from_python_only_the_foreign_environments_are_in_the_way(installed, tmp_path):
    """A folder `experiments` is common beside a script, and the library does not import ours."""
    command = [installed / "python", "-c", "import mapg_jax; print(mapg_jax.Config().heads)"]
    foreign(tmp_path, "experiments")
    assert run(command, tmp_path).stdout == "10\n"
    package = foreign(tmp_path, "envs")
    last = run(command, tmp_path).stderr.splitlines()[-1]
    assert last.startswith(f"ImportError: {package} is imported in place of mapg-jax's own")
