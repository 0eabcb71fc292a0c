"""A short form of `make torture`: nothing is used that was not saved, and nothing half-written."""

import pytest

from benchmarks.torture import damages, hostile


@pytest.fixture(scope="module")
def prepared(tmp_path_factory):
    root = tmp_path_factory.mktemp("torture")
    damages.prepare(root)
    return root


def is_fault(outcome: str) -> bool:
    return outcome.split(":")[0].isupper()


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(1_000_000, 1_000_010))
def test_a_damaged_run_folder_is_what_was_saved_or_is_refused(prepared, seed):
    damage, outcome = damages.scenario(seed)
    assert not is_fault(outcome), f"{damage}: {outcome}"


@pytest.mark.parametrize("seed", range(1_000_000, 1_000_025))
def test_a_hostile_command_line_begins_or_is_refused(tmp_path, seed):
    command, outcome = hostile.scenario(seed, tmp_path)
    assert not is_fault(outcome), f"{command}: {outcome}"
