"""benchmarks.reach with learners that only write evaluations: nothing is trained here."""

import math
import signal
import subprocess
import sys
import threading
import time

import pytest

from benchmarks import page, reach, reach_runs
from benchmarks.reach_runs import Learner, Result, Task
from mapg_jax.runs import csv_file

INF = math.inf
WRITES = """
import pathlib, sys, time
folder = pathlib.Path(sys.argv[sys.argv.index("--out") + 1])
folder.mkdir()
rows = ["env_steps,return_mean", *(f"{k},{x}" for k, x in enumerate(sys.argv[1].split(",")))]
(folder / "metrics.csv").write_text("\\n".join(rows) + "\\n")
time.sleep(60)
"""


def learner(name: str, returns: str, heads: int = 0) -> Learner:
    """It has these returns, one evaluation a step, and learns on."""
    return Learner(name, (sys.executable, "-c", WRITES, returns), f"of {name}", heads)


LEARNERS = {
    "up": (
        learner("ours, DDPG", "1,9,7", 1),
        learner("ours, M = 10", "1,2,8", 10),
        learner("ours, PPO", "8", 1),
        learner("theirs", "0,1,2"),
    )
}


@pytest.fixture(autouse=True)
def elsewhere(tmp_path, monkeypatch):
    """A task of a second, and files of its own."""
    monkeypatch.setattr(reach_runs, "TASKS", {"up": Task(5.0, 1.0)})
    monkeypatch.setattr(reach_runs, "LEARNERS", LEARNERS)
    monkeypatch.setattr(reach_runs, "FILE", tmp_path / "reach.csv")
    monkeypatch.setattr(page, "FILE", tmp_path / "results.md")


def result(name: str, seed: int, seconds: float, steps: float = 100.0) -> Result:
    return Result("up", name, seed, seconds, steps, 6.0 if seconds < INF else 1.0, 60.0)


ROWS = [{"env_steps": k, "return_mean": x} for k, x in enumerate([math.nan, 4.0, 5.0, 9.0])]


def test_the_first_evaluation_that_reaches_counts():
    assert reach_runs.outcome(ROWS, 3.0, Task(5.0, 10.0)) == (3.0, 2, 5.0)
    assert reach_runs.outcome(ROWS, 3.0, Task(9.5, 10.0)) is None
    assert reach_runs.outcome(ROWS, 10.5, Task(9.5, 10.0)) == (INF, 3, 9.0)


def test_what_is_late_has_not_reached():
    assert reach_runs.outcome(ROWS, 10.5, Task(5.0, 10.0)) == (INF, 3, 9.0)
    assert str(reach_runs.outcome([], 10.5, Task(5.0, 10.0))) == "(inf, nan, nan)"


def test_a_run_is_timed_from_outside_and_ended():
    begun = time.monotonic()
    reached = reach_runs.measure("up", LEARNERS["up"][1], 0, threading.Event())
    assert reached and reached.reached
    assert reached[:3] == ("up", "ours, M = 10", 0)
    assert 0 < reached.seconds < time.monotonic() - begun
    assert (reached.env_steps, reached.return_mean) == (2, 8.0)
    missed = reach_runs.measure("up", LEARNERS["up"][3], 0, threading.Event())
    assert missed and not missed.reached
    assert (missed.env_steps, missed.return_mean) == (2, 2.0)


def test_a_run_that_ends_by_itself_is_an_error():
    broken = Learner("broken", (sys.executable, "-c", "raise SystemExit('no such thing')"), "")
    with pytest.raises(RuntimeError, match="ended by itself: no such thing"):
        reach_runs.measure("up", broken, 0, threading.Event())


def test_ours_go_on_as_a_pair_with_ten_heads():
    def pair(ddpg: float, ten: float, ppo: float) -> list[str]:
        names = ("ours, DDPG", "ours, M = 10", "ours, PPO")
        found = [result(*x) for x in zip(names, (0, 0, 0), (ddpg, ten, ppo), strict=True)]
        return [x.name for x in reach_runs.kept("up", found)]

    assert pair(1, 3, 2) == ["ours, DDPG", "ours, M = 10", "theirs"]
    assert pair(2, 1, 3) == ["ours, M = 10", "ours, DDPG", "theirs"]
    assert pair(INF, INF, 1) == ["ours, PPO", "ours, M = 10", "theirs"]
    one = [result("ours, DDPG", 0, 1.0)]
    assert [x.name for x in reach_runs.kept("up", one)] == ["theirs"]  # ours have not all run


def test_it_goes_on_where_it_stopped_seed_by_seed():
    reach_runs.train(["up"], 2)
    found = reach_runs.results(reach_runs.FILE)
    by_seed = [{x.learner for x in found if x.seed == seed} for seed in reach_runs.SEEDS]
    assert by_seed[0] == {x.name for x in LEARNERS["up"]}
    assert all(len(x) == 3 and "theirs" in x for x in by_seed[1:])
    assert [x.seed for x in found] == sorted(x.seed for x in found)
    written = csv_file.read(reach_runs.FILE)
    csv_file.write(reach_runs.FILE, written[0], written[1][:-1])
    reach_runs.train(["up"], 1)
    last = reach_runs.results(reach_runs.FILE)[-1]
    assert last[:3] == found[-1][:3]
    whole = reach_runs.FILE.read_bytes()
    reach_runs.train(["up"], 1)
    assert reach_runs.FILE.read_bytes() == whole


def test_results_read_back_as_they_were_written():
    found = [result("ours, DDPG", 0, 1.5), result("theirs", 0, INF)]
    csv_file.write(reach_runs.FILE, reach_runs.HEADER, map(reach_runs.as_row, found))
    assert reach_runs.results(reach_runs.FILE) == found


def test_a_signal_ends_the_runs_and_leaves_the_file_whole(tmp_path):
    program = (
        "import signal, sys, pathlib\n"
        "from benchmarks import reach_runs\n"
        f"reach_runs.FILE = pathlib.Path({str(reach_runs.FILE)!r})\n"
        "reach_runs.TASKS = {'up': reach_runs.Task(5.0, 60.0)}\n"
        f"slow = reach_runs.Learner('slow', (sys.executable, '-c', {WRITES!r}, '1'), '')\n"
        f"quick = reach_runs.Learner('quick', (sys.executable, '-c', {WRITES!r}, '6'), '')\n"
        "reach_runs.LEARNERS = {'up': (quick, slow)}\n"
        "signal.signal(signal.SIGTERM, lambda *_: sys.exit(143))\n"
        "reach_runs.train(['up'], 1)\n"
    )
    with subprocess.Popen([sys.executable, "-c", program], stdout=subprocess.PIPE) as process:
        assert process.stdout.readline().startswith(b"up quick 0 ")  # the other one has begun
        process.send_signal(signal.SIGTERM)
        assert process.wait(10) == 143
    (found,) = reach_runs.results(reach_runs.FILE)
    assert found[:3] == ("up", "quick", 0)
    assert not list(tmp_path.glob("*.partial"))


def test_medians_count_what_has_not_reached_as_longest():
    def cell(*seconds: float) -> reach.Cell:
        found = [result("ours, DDPG", 0, 1.0), result("ours, PPO", 0, 2.0)]
        found += [result("ours, M = 10", k, x) for k, x in enumerate(seconds)]
        return next(x for x in reach.cells("up", found) if x.learner.heads == 10)

    assert cell(3.0, INF, 4.0).median == 4.0
    assert cell(3.0, INF, INF).median == INF
    rows = {row[0]: row for row in reach.table("up", MADE).rows}
    assert rows["ours, M = 10"][1:4] == ("20.0 (10.0 to over 60)", "2 of 3", "400")
    assert rows["theirs"][1:4] == ("over 60 (50.0 to over 60)", "1 of 3", "800")


MADE = [
    result("ours, DDPG", 0, 12.0),
    result("ours, PPO", 0, INF),
    *(result("ours, M = 10", k, x, 400.0) for k, x in enumerate([10.0, 20.0, INF])),
    *(result("theirs", k, x, 800.0) for k, x in enumerate([INF, 50.0, INF])),
]


def test_the_verdict_says_who_is_shortest_and_by_what():
    few = [result("ours, DDPG", 0, 9.0), result("ours, PPO", 0, INF)]
    few += [result("ours, M = 10", 0, 20.0, 600.0), result("theirs", 0, 4.0, 50.0)]
    assert reach.verdict("up", few) == (
        "The shortest is theirs, 4.0 s; ours, DDPG, the shortest of ours, takes 2.2 times as long: "
        "2 times the environment steps, 0.89 times as many a second."
    )
    assert reach.verdict("up", MADE) == (
        "The shortest is ours, DDPG, 12.0 s; none of the peers' reaches it by most seeds."
    )
    assert reach.verdict("up", few[:2]) == "Not all of it has been run yet."


def test_the_section_takes_its_place_on_the_page():
    assert "not measured" in reach.report()
    csv_file.write(reach_runs.FILE, reach_runs.HEADER, map(reach_runs.as_row, MADE))
    section = reach.report()
    assert "### up, 5 within 1 s" in section
    assert "ours, PPO (of ours, PPO) over 60" in section
    page.FILE.write_text("# Speed\n\nof it\n\n## Wall time to a given return\n\nold\n\n## B\n\nb\n")
    page.renew(section)
    page.renew(section)
    written = page.FILE.read_text()
    assert written.count("## Wall time to a given return\n") == 1
    assert "old" not in written and written.endswith("\n\n## B\n\nb\n")
    page.renew("## C\n\nnew")
    assert page.FILE.read_text().startswith(written.rstrip() + "\n\n## C\n\nWritten by itself")
    assert page.FILE.read_text().endswith(".\n\nnew\n")  # a table needs a line of its own before


def test_no_two_learners_of_a_task_have_one_name(monkeypatch):
    monkeypatch.undo()
    for learners in reach_runs.LEARNERS.values():
        names = [x.name for x in learners]
        assert len(set(names)) == len(names)
