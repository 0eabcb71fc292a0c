"""The examples of docs/extending.md and of the README, as a reader would run them.

Of the README's commands, those that train are run with fewer steps (slow), the others on policies
of the zoo; of those that serve or train for hours whatever they are told, the flags are read. (What
they do is tested in tests/cli and tests/experiments.)
"""

import importlib
import os
import pathlib
import re
import shlex
import shutil
import subprocess
import sys

import pytest

PAGE = pathlib.Path(__file__).parent.parent / "docs" / "extending.md"
BLOCKS = re.findall(r"<!-- (.*?) -->\n```\w+\n(.*?)```", PAGE.read_text(), re.DOTALL)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Where the page's files lie."""
    root = tmp_path_factory.mktemp("extending")
    for mark, text in BLOCKS:
        if mark.startswith("file: "):
            (root / mark.removeprefix("file: ")).write_text(text)
    return root


def run(command, folder):
    done = subprocess.run(
        command, cwd=folder, capture_output=True, text=True, env={**os.environ, "COLUMNS": "200"}
    )
    assert done.returncode == 0, done.stderr
    return done.stdout


@pytest.mark.slow
def test_the_algorithm_trains_sweeps_and_keeps_the_contract(folder):
    (shell,) = (text for mark, text in BLOCKS if mark == "shell")
    for line in shell.splitlines():
        name, *arguments = line.split()
        assert name == "mapg"
        out = run([sys.executable, "-m", "mapg_jax", *arguments], folder)
        assert "pendulum" in out
    assert {path.parent.name for path in folder.glob("swept/*/evaluation.json")} == {
        "pendulum-constant-m1", "pendulum-constant-m3", "pendulum-mapg-m1", "pendulum-mapg-m3",
    }  # fmt: skip
    (check,) = (text for mark, text in BLOCKS if mark == "python: constant.py")
    run([sys.executable, "-c", check], folder)


@pytest.mark.parametrize("text", [text for mark, text in BLOCKS if mark == "python"])
def test_an_example_in_python_runs(text, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    exec(compile(text, str(PAGE), "exec"), {})


README = (PAGE.parent.parent / "README.md").read_text()
SNIPPETS = re.findall(r"```python\n(.*?)```", README, re.S)


@pytest.mark.parametrize(
    "text",
    [pytest.param(SNIPPETS[0], marks=pytest.mark.slow), *SNIPPETS[1:]],  # the second trains, too
)
def test_a_snippet_of_the_readme_runs(text, tmp_path, monkeypatch):
    """With fewer steps, and a run to load where it begins with one that the reader has."""
    monkeypatch.chdir(tmp_path)
    short = re.sub(r"steps=[\d_]+", "steps=400, evaluate_every=400, final_episodes=2", text)
    exec(compile(short, "README.md", "exec"), {})


COMMANDS = re.findall(r"^    (mapg \w.*?)(?:  +#.*)?$", README, re.M)
FEW = " --steps 800 --evaluate-every 400 --evaluation-episodes 1 --final-episodes 2"
BRIEFLY = {
    "evaluate": " --episodes 2",
    "watch": " --steps 3",
    "export": "",
    "report": "",
    "resume": "",
    "envs": "",
    "draw": "",
    "train": FEW,
    "sweep": f"{FEW} --heads 1 2 --seeds 1",
    "search": f"{FEW} --trials 1",
}
"""Commands that are run, with fewer steps."""
LONG = ("train", "sweep", "search", "draw")
THERE = {
    "zoo/pendulum-m10": "pendulum-m10",
    "runs/hopper-m10": "pendulum-m10",  # whose pictures need no OpenGL
    "runs/driving-mapg-m10-1": "driving-m10",
}
"""What a reader has by then, of the zoo; a command that trains makes its own."""
RUN = [
    pytest.param(line, marks=[pytest.mark.slow] * (line.split()[1] in LONG))
    for line in COMMANDS
    if line.split()[1] in BRIEFLY and "playground:" not in line  # an extra
]


def command(line):
    name, *flags = shlex.split(line.partition(" > ")[0])[1:]
    module = importlib.import_module(f"mapg_jax.cli.{name}")
    return module, module.parse(flags)


@pytest.mark.parametrize("line", RUN)
def test_a_command_of_the_readme_runs(line, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    if " train " not in line:
        for there, policy in THERE.items():
            shutil.copytree(PAGE.parent.parent / "zoo" / policy, there)
    module, arguments = command(line + BRIEFLY[line.split()[1]])
    said = tmp_path / "said.txt"
    with said.open("w") as out:
        module.run(arguments, out)
    assert said.read_text()


@pytest.mark.parametrize("line", COMMANDS)
def test_a_command_of_the_readme_is_understood(line):
    """Its flags are those of the command; what it needs beside them may not be there."""
    command(line)


def test_the_plain_words_of_the_readme_have_the_numbers_of_the_results():
    """Every one with its sign stands in the lines of a claim that is named beside it."""
    page = (PAGE.parent.parent / "results" / "README.md").read_text()
    words = README.partition("In plain words")[2].partition("<!-- answer -->")[0]
    number = r"-?\d+\.\d+(?:e-\d+)?|\d+%"
    found = 0
    for item in re.split(r"^- ", words, flags=re.M)[1:]:
        said = re.findall(number, item)
        named = set(re.findall(r"\bC\d+[ab]?\b", item))
        lines = [x for claim in named for x in re.findall(rf"^[|-] {claim}[ab: ].*", page, re.M)]
        lines += re.findall(r"^\| \d+ \|.*", page, re.M) if "C7" in named else []  # the costs by M
        assert set(said) <= set(re.findall(number, "\n".join(lines))), item[:60]
        found += len(said)
    assert found > 10


def test_the_speeds_of_the_readme_are_those_of_the_page():
    page = (PAGE.parent.parent / "benchmarks" / "results.md").read_text()
    (paragraph,) = re.findall(r"^On 2 cores and at one update a step.*?\(\[", README, re.M | re.S)
    rows = re.findall(r"^\| (SBX|Stable-Baselines3|rejax),.*?\| [\d,]+ \| ([\d.]+) \(", page, re.M)
    (cost,) = re.findall(r"M = 10 takes ([\d.]+) times the time of M = 1", page, re.M)
    assert [name for name, _ in rows] == ["SBX", "Stable-Baselines3", "rejax"]
    (by_round,) = re.findall(r"^\| M = 10 \| .*? \(([\d.]+ to [\d.]+)\)", page, re.M)
    assert re.findall(r"([\d.]+) times", paragraph) == [*(times for _, times in rows), cost]
    assert f"by round {by_round}" in paragraph


def test_who_is_first_to_a_return_is_as_the_page_has_it():
    page = (PAGE.parent.parent / "benchmarks" / "results.md").read_text()
    section = page.partition("## Wall time to a given return")[2].partition("\n## ")[0]
    places = {}
    for of_task in section.split("\n### ")[1:]:
        names = re.findall(r"^\| ([\w-]+), (\w+)[ ,]", of_task, re.M)
        places[of_task.partition(",")[0]] = names.index(("mapg-jax", "PPO")) + 1
    assert "rejax's algorithms on Pendulum, before the first two's on HalfCheetah" in README
    assert "and after Stable-Baselines3's on Hopper" in README
    assert places == {"pendulum": 1, "halfcheetah": 1, "hopper": 2}


def test_what_the_readme_finds_is_what_the_results_say():
    """The cost of heads, and the p by which C5a falls."""
    results = (PAGE.parent.parent / "results/README.md").read_text()
    cost = re.search(r"Ten actions take ([\d.]+) times the time of one, fifty ([\d.]+)", README)
    p = re.search(r"C5a: p ([\d.]+) where ([\d.]+) decides", README)
    assert cost and p
    for heads, ratio in zip((10, 50), cost.groups(), strict=True):
        assert re.search(rf"^\| {heads} \| \d+ \| {ratio} \(", results, re.M)
    found, level = p.groups()
    assert re.search(
        rf"C5a each: p .*\(one against below {level} contradicts\).* / {found}\.", results
    )
