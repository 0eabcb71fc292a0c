"""Which runs go together, and what is refused because memory or disk would not suffice."""

import dataclasses
import pathlib

import oracles
import pytest

from mapg_jax.sweeps import groups as module
from mapg_jax.sweeps import sweep
from mapg_jax.sweeps.groups import Job, groups, workers_that_fit

RUN = dataclasses.replace(oracles.RUN, steps=400, checkpoint_seconds=300.0, checkpoints_kept=2)


def jobs(**changes) -> list[Job]:
    cells = [dataclasses.replace(RUN, heads=m, **changes) for m in (1, 4, 10)]
    return [Job(cell, pathlib.Path(f"nowhere/{cell.heads}")) for cell in cells]


def test_groups_are_cut_as_asked():
    mixed = [*jobs(), *(job._replace(path=job.path / "b") for job in jobs(batch_size=4))]
    sizes = {k: [len(group) for group in groups(mixed, k)] for k in ("auto", "one", "all", 2)}
    assert sizes == {"auto": [1] * 6, "one": [1] * 6, "all": [3, 3], 2: [2, 1, 2, 1]}
    for cut in (groups(mixed, "all"), groups(mixed, 2)):
        assert sorted(job.path for group in cut for job in group) == sorted(j.path for j in mixed)
    for wrong in (0, "some"):
        with pytest.raises(ValueError, match=f"all or at least 1, got {wrong!r}"):
            groups(mixed, wrong)


def test_accelerators_get_as_many_as_fit(monkeypatch):
    monkeypatch.setattr(module.jax, "default_backend", lambda: "gpu")
    each = module.group_bytes((jobs()[2],))
    monkeypatch.setattr(module, "available_bytes", lambda: 5 * each)
    assert [len(group) for group in groups(jobs(), "auto")] == [2, 1]  # in half of it
    assert workers_that_fit(groups(jobs(), "auto")) == 1
    monkeypatch.setattr(module.jax, "local_device_count", lambda: 4)
    assert workers_that_fit(groups(jobs(), "one")) == 3  # one each, and there are three groups
    monkeypatch.setattr(module.jax, "local_device_count", lambda: 1)
    monkeypatch.setattr(module, "available_bytes", lambda: 2 * each + each // 2)
    with pytest.raises(ValueError, match="do not fit"):
        workers_that_fit(groups(jobs(), "all"))


def test_no_accelerator_is_idle(tmp_path, monkeypatch):
    """Though the memory of one would hold all runs."""
    monkeypatch.setattr(module.jax, "default_backend", lambda: "gpu")
    monkeypatch.setattr(module, "available_bytes", lambda: 10**12)
    runs = [(dataclasses.replace(RUN, seed=seed), tmp_path / f"{seed}") for seed in range(10)]
    for workers, sizes in ((None, [3, 3, 3, 1]), (1, [10]), (2, [5, 5])):
        monkeypatch.setattr(module.jax, "local_device_count", lambda: 4)
        schedule = sweep.make_schedule(runs, workers=workers)
        assert [len(group) for group in schedule.groups] == sizes
        assert schedule.workers == len(sizes)


def test_workers_are_as_many_as_memory_allows(monkeypatch):
    cut = groups(jobs(), "one")
    monkeypatch.setattr(module, "cpus", lambda: 3)
    monkeypatch.setattr(module, "available_bytes", lambda: 2_500_000_000)
    assert workers_that_fit(cut) == 2  # each takes 1 GB and its state
    assert workers_that_fit(cut, 1) == 1
    with pytest.raises(ValueError, match="workers must be at least 1, got 'x'"):
        workers_that_fit(cut, "x")
    with pytest.raises(ValueError, match="3 at a time"):
        workers_that_fit(cut, 3)
    monkeypatch.setattr(module, "available_bytes", lambda: 500_000_000)
    with pytest.raises(ValueError, match=r"0\.5 GB that are available"):
        workers_that_fit(cut)


def test_checkpoints_that_are_there_count_as_room(tmp_path, monkeypatch):
    """A sweep that was stopped needs no more of the disk than when it began."""
    cut = [(jobs()[0]._replace(path=tmp_path / "run"),)]
    needed = module.disk_bytes(cut, 1, keep_replay=False)
    monkeypatch.setattr(module.disk, "free_bytes", lambda path: needed - 1000)
    with pytest.raises(ValueError, match="the checkpoints can take"):
        module.refuse_a_full_disk(cut, 1, keep_replay=False)
    (tmp_path / "run" / "checkpoints" / "400").mkdir(parents=True)
    (tmp_path / "run" / "checkpoints" / "400" / "data").write_bytes(bytes(1000))
    module.refuse_a_full_disk(cut, 1, keep_replay=False)


def test_a_resumed_group_keeps_the_program_of_all_its_runs(monkeypatch):
    """What is done is idle in it, and runs without a common step go one after the other."""
    group = tuple(jobs())
    one, four, ten = (job.path for job in group)
    left = module.with_work_for(group, {four, ten})
    assert [job.idle for job in left] == [True, False, False]
    assert [job.path for job in module.at_work(left)] == [four, ten]
    steps = {four: [10, 20], ten: [20, 30]}
    monkeypatch.setattr(module, "_steps", steps.get)
    assert module.parts(left) == [left]
    for steps[ten], apart in (([30], True), ([], True), ([20], False)):
        found = module.parts(left)
        assert len(found) == 1 + apart
        assert all(len(part) == 3 for part in found)
        assert sorted(j.path for part in found for j in module.at_work(part)) == sorted([four, ten])
    steps.update({four: [], ten: []})  # nothing was done yet
    assert module.parts(left) == [left]
    assert one not in steps
