"""The order of the house: a file imports only from those above it."""

import ast
import itertools
import pathlib

import pytest

ROOT = pathlib.Path(__file__).parent.parent
ROOMS = {
    "algorithms": (
        "shards",
        "options",
        "base",
        "heads",
        "layer_norm",
        "networks",
        "exploration",
        "normalization",
        "descent",
        "returns",
        "mixture",
        "repulsion",
        "optima",
        "twin_critics",
        "head_options",
        "deterministic",
        "mapg",
        "td3",
        "sac",
        "naf",
        "a3c",
        "on_policy",
        "ppo",
        "trpo",
        "registry",
    ),
    "training": (
        "config",
        "replay",
        "agent",
        "state",
        "layout",
        "turns",
        "evaluation",
        "trainer",
        "lockstep",
        "plugins",
    ),
    "runs": (
        "whole_file",
        "csv_file",
        "hosts",
        "locking",
        "signals",
        "host",
        "folder",
        "checkpoint_record",
        "checkpoints",
        "contract",
        "metrics",
        "sealing",
        "progress",
        "memory",
        "policy",
        "disk",
        "export",
        "scoring",
        "episode",
        "video",
        "live",
        "curve",
        "finishing",
        "member",
        "run",
        "trackers",
        "train",
    ),
    "sweeps": (
        "grid",
        "groups",
        "forecast",
        "task",
        "launchers",
        "slurm",
        "ray_tasks",
        "folder",
        "worker",
        "pool",
        "table",
        "sweep",
        "search",
    ),
    "reports": (
        "results",
        "results_csv",
        "inference",
        "stratified",
        "document",
        "tables",
        "plots",
        "report",
        "live_runs",
        "dashboard",
        "sharing",
    ),
    "cli": (
        "console",
        "completion",
        "parser",
        "fields",
        "config_file",
        "main",
        "score",
        "train",
        "sweep",
        "search",
        "resume",
        "evaluate",
        "draw",
        "export",
        "watch",
        "report",
        "dashboard",
        "push",
        "pull",
        "paper",
        "envs",
    ),
}
"""Folders of `mapg_jax`, and the files of each, from top to bottom; CONTRIBUTING.md draws them."""
PACKAGE = ("foreign", "registration", "__init__", "__main__")
"""Beside the rooms: what stands before them, and the two names of the whole."""
FILES = [f"{room}.{file}" for room, files in ROOMS.items() for file in files]
PURE = FILES[: FILES.index("training.trainer")]
"""No jit, no printing, no files, no state of their own; the trainer is where a program is made."""
STATE = {"algorithms.registry": {"_ALGORITHMS"}}
"""Names that `register` makes known for the whole process: by design, and nowhere else."""


def path_of(file: str) -> pathlib.Path:
    return ROOT / "mapg_jax" / f"{file.replace('.', '/')}.py"


def files_of(*packages: str) -> list[pathlib.Path]:
    """All Python files of those packages."""
    return sorted(itertools.chain(*((ROOT / package).rglob("*.py") for package in packages)))


def imports(path: pathlib.Path):
    """Modules that a file imports, wherever in it, as dotted names."""
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path}: relative import"
            yield node.module or ""
            yield from (f"{node.module}.{alias.name}" for alias in node.names)


def packages_of(path: pathlib.Path) -> set[str]:
    return {name.split(".")[0] for name in imports(path)}


def imported_files(path: pathlib.Path) -> set[str]:
    """Those of FILES that a file imports."""
    names = (name.removeprefix("mapg_jax.") for name in imports(path))
    return {file for name in names for file in FILES if name == file or name.startswith(f"{file}.")}


def test_every_file_has_its_room():
    rooms = {room: set(files) for room, files in ROOMS.items()}
    found = {
        folder.name: {file.stem for file in folder.glob("*.py")} - {"__init__"}
        for folder in (ROOT / "mapg_jax").iterdir()
        if any(folder.glob("*.py"))
    }
    assert found == rooms
    assert {file.stem for file in (ROOT / "mapg_jax").glob("*.py")} == set(PACKAGE)


@pytest.mark.parametrize("file", FILES)
def test_imports_point_one_way(file):
    above = FILES[: FILES.index(file)]
    for other in imported_files(path_of(file)):
        assert other in above, f"{file} imports {other}, which is not above it"
    packages = packages_of(path_of(file))
    assert not packages & {"benchmarks", "tests"}
    # The command line is the door to the experiments, which stand on all other rooms.
    assert "experiments" not in packages or file.startswith("cli.")


def test_the_package_offers_what_is_above_the_command_line():
    assert not imported_files(path_of("foreign"))
    offered = imported_files(path_of("__init__"))
    assert offered
    assert not {file for file in offered if file.startswith("cli.")}
    assert imported_files(path_of("__main__")) == {"cli.main"}


def test_environments_know_nothing_of_the_learner():
    for path in files_of("envs"):
        assert not packages_of(path) & {"mapg_jax", "experiments", "benchmarks", "tests"}, path


def test_experiments_know_nothing_of_the_command_line():
    assert any("mapg_jax" in packages_of(path) for path in files_of("experiments"))
    for path in files_of("experiments"):
        assert not packages_of(path) & {"benchmarks", "tests"}, path
        commands = {file for file in imported_files(path) if file.startswith("cli.")}
        assert not commands, path
        assert "mapg_jax.cli" not in set(imports(path)), path


def test_only_the_command_line_knows_the_experiments():
    """One command of it; nothing in the rooms above names an experiment."""
    knowing = {path for path in files_of("mapg_jax") if "experiments" in packages_of(path)}
    assert knowing == {path_of("cli.paper")}


@pytest.mark.parametrize("file", PURE)
def test_the_rooms_above_the_trainer_compute_and_nothing_else(file):
    forbidden = {"jit", "pmap", "print", "open", "write_text", "read_text", "device_put"}
    tree = ast.parse(path_of(file).read_text())
    for node in ast.walk(tree):
        if isinstance(node, ast.Attribute):
            assert node.attr not in forbidden, f"{file}, line {node.lineno}: {node.attr}"
        elif isinstance(node, ast.Name):
            assert node.id not in forbidden, f"{file}, line {node.lineno}: {node.id}"
        assert not isinstance(node, ast.Global | ast.Nonlocal), f"{file}, line {node.lineno}"
    assert changed(tree) == STATE.get(file, set())


def changed(tree: ast.Module) -> set[str]:
    """Names of a module whose values its functions change in place."""
    changes = {"append", "extend", "add", "update", "setdefault", "pop", "remove", "clear"}
    found = set()
    for node in ast.walk(tree):
        if (isinstance(node, ast.Subscript) and not isinstance(node.ctx, ast.Load)) or (
            isinstance(node, ast.Attribute) and node.attr in changes
        ):
            found |= {node.value.id} if isinstance(node.value, ast.Name) else set()
    targets = (node.targets for node in tree.body if isinstance(node, ast.Assign))
    annotated = ([node.target] for node in tree.body if isinstance(node, ast.AnnAssign))
    names = itertools.chain(*targets, *annotated)
    return found & {name.id for name in names if isinstance(name, ast.Name)}


def test_modules_are_small():
    """Rarely over 300 lines."""
    long = {
        str(path.relative_to(ROOT)): lines
        for path in files_of("mapg_jax", "envs", "experiments")
        if (lines := len(path.read_text().splitlines())) > 400
    }
    assert not long
