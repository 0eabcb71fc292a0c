"""The order of the rooms: a file imports only from those above it."""

import ast
import pathlib

import pytest

ROOT = pathlib.Path(__file__).parent.parent
ROOMS = (
    "exploration",
    "heads",
    "networks",
    "normalization",
    "replay",
    "descent",
    "mapg",
    "a3c",
    "config",
    "agent",
    "loop",
    "a3c_training",
    "training",
    "locking",
    "run_folder",
    "checkpointing",
    "policy",
    "evaluation",
    "tracking",
    "statistics",
    "results",
    "plotting",
    "document",
    "tables",
    "report",
    "scoring",
    "recording",
    "finishing",
    "lockstep",
    "signals",
    "member",
    "runner",
    "grid",
    "grouping",
    "timing",
    "worker",
    "workers",
    "sweep_table",
    "sweep",
    "sweep_folder",
    "__init__",
    "console",
    "sweep_command",
    "cli",
    "__main__",
)
PURE = ROOMS[: ROOMS.index("loop")]


def imports(path):
    """Modules that a file imports, as dotted names."""
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path}: relative import"
            yield node.module or ""
            yield from (f"{node.module}.{alias.name}" for alias in node.names)


def test_every_file_has_its_room():
    assert {path.stem for path in (ROOT / "mapg_jax").glob("*.py")} == set(ROOMS)


@pytest.mark.parametrize("room", ROOMS)
def test_imports_point_one_way(room):
    above = ROOMS[: ROOMS.index(room)]
    for name in imports(ROOT / "mapg_jax" / f"{room}.py"):
        package, *rest = name.split(".")
        if package == "mapg_jax" and rest and rest[0] in ROOMS:
            assert rest[0] in above, f"{room}.py imports {rest[0]}.py, which is not above it"
        assert package not in {"benchmarks", "tests"}
        # The command line is the door to the experiments, which stand on all other rooms.
        assert package != "experiments" or room == "cli"


def test_environments_know_nothing_of_the_learner():
    for path in (ROOT / "envs").rglob("*.py"):
        packages = {name.split(".")[0] for name in imports(path)}
        assert not packages & {"mapg_jax", "experiments", "benchmarks", "tests"}, path


@pytest.mark.parametrize("room", PURE)
def test_the_rooms_above_the_loop_compute_and_nothing_else(room):
    """No jit, no printing, no files, no global state."""
    forbidden = {"jit", "pmap", "print", "open", "write_text", "read_text", "device_put"}
    for node in ast.walk(ast.parse((ROOT / "mapg_jax" / f"{room}.py").read_text())):
        if isinstance(node, ast.Attribute):
            assert node.attr not in forbidden, f"{room}.py, line {node.lineno}: {node.attr}"
        elif isinstance(node, ast.Name):
            assert node.id not in forbidden, f"{room}.py, line {node.lineno}: {node.id}"
        assert not isinstance(node, ast.Global | ast.Nonlocal)


def test_modules_are_small():
    """Rarely over 300 lines."""
    for path in (*(ROOT / "mapg_jax").glob("*.py"), *(ROOT / "envs").rglob("*.py")):
        assert len(path.read_text().splitlines()) <= 330, path
