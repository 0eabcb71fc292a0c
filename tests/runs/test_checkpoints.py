"""What is saved comes back to the last bit; what is damaged is named."""

import dataclasses
import shutil

import jax
import jax.numpy as jnp
import numpy as np
import oracles
import orbax.checkpoint as ocp
import pytest

from mapg_jax.runs.checkpoints import Checkpoints, DamagedError
from mapg_jax.training.trainer import make_trainer

CONFIG = dataclasses.replace(oracles.TINY, replay_size=1000)


@pytest.fixture(scope="module")
def trainer():
    return make_trainer(CONFIG)


@pytest.fixture(scope="module")
def states(trainer):
    """After 5 and after 300 turns: the replay partly filled, and wrapped."""
    return [trainer.jitted_run(trainer.jitted_init(0), turns) for turns in (5, 300)]


def test_every_leaf_comes_back(trainer, states, tmp_path):
    checkpoints = Checkpoints(tmp_path / "checkpoints", kept=2)
    for state in states:
        checkpoints.save(state, {"seconds": 1.5})
        restored, host = Checkpoints(tmp_path / "checkpoints").load(trainer.shapes)
        oracles.assert_equal(restored, state)
        assert host == {"seconds": 1.5}
        same = jax.tree.map(lambda x, y: x.dtype == y.dtype, restored, state)
        assert all(jax.tree.leaves(same))
        agent, steps = Checkpoints(tmp_path / "checkpoints").load_agent(trainer.shapes.agent)
        oracles.assert_equal(agent, state.agent)
        assert steps == state.env_steps


def test_empty_arrays_come_back(trainer, states, tmp_path):
    """A state of MJX has some, where a model has no muscles or tendons."""
    state = states[0].replace(explorer=jnp.zeros((4, 0)))
    shapes = trainer.shapes.replace(explorer=jax.ShapeDtypeStruct((4, 0), jnp.float32))
    checkpoints = Checkpoints(tmp_path / "checkpoints", kept=1)
    checkpoints.save(state, {})
    oracles.assert_equal(checkpoints.load(shapes)[0], state)


def test_only_filled_slots_are_written(states, tmp_path):
    for state in states:
        slots = min(int(state.env_steps), 1000)
        Checkpoints(tmp_path / "checkpoints", kept=1).save(state, {})
        path = tmp_path / "checkpoints" / str(state.env_steps) / "rest"
        with ocp.StandardCheckpointer() as checkpointer:
            stored = checkpointer.restore(path)
        names = [name for name in stored if name.startswith(".replay.data")]
        assert len(names) == len(jax.tree.leaves(state.replay.data))
        filled = {name: len(stored[name]) for name in names}
        assert filled.pop(".replay.data.observations") == int(state.replay.rows) >= slots
        assert set(filled.values()) == {slots}


def test_what_is_written_is_what_was_there_when_it_began(trainer, states, tmp_path):
    """Later chunks write over the buffers of the state."""
    checkpoints = Checkpoints(tmp_path / "checkpoints", kept=2)
    state = jax.tree.map(_own_buffer, states[1])
    checkpoints.begin_to_save(state, {})
    for leaf in jax.tree.leaves(state):
        if isinstance(leaf, np.ndarray):
            leaf.fill(0)
    checkpoints.wait()
    oracles.assert_equal(Checkpoints(tmp_path / "checkpoints").load(trainer.shapes)[0], states[1])


def _own_buffer(leaf):
    keys = jnp.issubdtype(leaf.dtype, jax.dtypes.prng_key)
    return leaf if keys else np.array(leaf, copy=True)


def test_what_cannot_be_written_is_said_when_it_is_waited_for(states, tmp_path):
    path = tmp_path / "checkpoints"
    checkpoints = Checkpoints(path, kept=2)
    checkpoints.save(states[0], {})
    shutil.rmtree(path)
    path.write_text("no folder")
    with pytest.raises(OSError, match=r"of step 1,200 cannot be written .*are whole"):
        checkpoints.save(states[1], {})


def test_the_newest_are_kept(states, tmp_path):
    checkpoints = Checkpoints(tmp_path / "checkpoints", kept=2)
    for steps in (10, 20, 30):
        checkpoints.save(states[0].replace(env_steps=jnp.int32(steps)), {})
    assert checkpoints.newest() == 30
    kept = {path.name for path in (tmp_path / "checkpoints").iterdir()}
    assert kept == {"20", "30"}


def test_half_written_checkpoints_are_not_seen(trainer, states, tmp_path):
    path = tmp_path / "checkpoints"
    Checkpoints(path, kept=2).save(states[0], {})
    shutil.copytree(path / "20", path / "40.orbax-checkpoint-tmp-1")
    checkpoints = Checkpoints(path)
    assert checkpoints.newest() == 20
    oracles.assert_equal(checkpoints.load(trainer.shapes)[0], states[0])


def test_no_checkpoint_is_named(trainer, tmp_path):
    for path in (tmp_path / "run" / "checkpoints", tmp_path / "empty" / "checkpoints"):
        if path.parent.name == "empty":
            path.mkdir(parents=True)
        checkpoints = Checkpoints(path)
        assert checkpoints.newest() is None
        with pytest.raises(ValueError, match=f"{path.parent} has no complete checkpoint"):
            checkpoints.load_agent(trainer.shapes.agent)
    assert not (tmp_path / "run").exists()  # reading writes nothing


@pytest.mark.parametrize("damage", ["emptied", "overwritten", "deleted"])
@pytest.mark.parametrize("part", ["agent", "rest"])
def test_damage_is_named(trainer, states, tmp_path, damage, part):
    path = tmp_path / "checkpoints"
    Checkpoints(path, kept=2).save(states[0], {})
    for file in (path / "20" / part).rglob("*"):
        if not file.is_file():
            continue
        if damage == "deleted":
            file.unlink()
        else:
            file.write_bytes(b"" if damage == "emptied" else b"\xff" * file.stat().st_size)
    with pytest.raises(ValueError, match=r"checkpoints.20 is damaged"):
        Checkpoints(path).load(trainer.shapes)


@pytest.mark.parametrize("changes", [{"heads": 4}, {"hidden": (9, 8)}, {"layer_norm": False}])
def test_another_configuration_is_refused(states, tmp_path, changes):
    Checkpoints(tmp_path / "checkpoints", kept=2).save(states[0], {})
    other = make_trainer(dataclasses.replace(CONFIG, **changes))
    with pytest.raises(ValueError, match=r"is of another configuration|where .* is expected"):
        Checkpoints(tmp_path / "checkpoints").load_agent(other.shapes.agent)


def flipped(file, bit):
    """A file with one bit turned over."""
    content = bytearray(file.read_bytes())
    content[bit // 8] ^= 1 << bit % 8
    file.write_bytes(content)


# TensorStore tells event loops of Orbax that have ended of what it could not read.
@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")
def test_no_flipped_bit_is_used(trainer, states, tmp_path):
    """Of 60 drawn ones: it is refused, or the state is the one that was saved."""
    path, rng, refused = tmp_path / "checkpoints", np.random.default_rng(0), 0
    Checkpoints(path, kept=2).save(states[0], {"seconds": 1.0})
    files = sorted(file for file in (path / "20").rglob("*") if file.stat().st_size)
    files = [file for file in files if file.is_file()]
    for _ in range(60):
        file = files[rng.integers(len(files))]
        whole = file.read_bytes()
        flipped(file, rng.integers(8 * len(whole)))
        try:
            loaded, host = Checkpoints(path).load(trainer.shapes)
        except DamagedError as error:
            refused += 1
            assert "\n" not in str(error)
        else:
            oracles.assert_equal(loaded, states[0])
            assert host == {"seconds": 1.0}
        file.write_bytes(whole)
    assert refused > 5


def test_parts_of_two_checkpoints_do_not_fit_together(trainer, states, tmp_path):
    path = tmp_path / "checkpoints"
    checkpoints = Checkpoints(path, kept=3)
    for state in states:
        checkpoints.save(state, {})
    checkpoints.save(states[0].replace(env_steps=jnp.int32(10)), {})
    (path / "10").rename(path / "30")
    with pytest.raises(DamagedError, match=r"30 is damaged .it is that of step 10"):
        Checkpoints(path).load(trainer.shapes, 30)
    for part in ("agent", "rest", "host"):
        shutil.copytree(path / "20" / part, tmp_path / part)
        shutil.rmtree(path / "20" / part)
        shutil.copytree(path / "1200" / part, path / "20" / part)
        with pytest.raises(DamagedError, match="20 is damaged"):
            Checkpoints(path).load(trainer.shapes, 20)
        shutil.rmtree(path / "20" / part)
        shutil.copytree(tmp_path / part, path / "20" / part)
    oracles.assert_equal(Checkpoints(path).load(trainer.shapes, 20)[0], states[0])


def test_a_checkpoint_of_another_configuration_is_refused(trainer, states, tmp_path):
    Checkpoints(tmp_path / "checkpoints", kept=2, config="one").save(states[0], {})
    with pytest.raises(ValueError, match=r"config\.json is not the configuration that"):
        Checkpoints(tmp_path / "checkpoints", config="another").load(trainer.shapes)


def test_the_agent_before_a_damaged_one_is_used(trainer, states, tmp_path, caplog):
    path = tmp_path / "checkpoints"
    for state in states:
        Checkpoints(path, kept=2).save(state, {})
    host = path / "1200" / "host" / "metadata"
    host.write_text(host.read_text().replace("1200", "1201", 1))
    agent, steps = Checkpoints(path).load_agent(trainer.shapes.agent)
    assert steps == 20
    oracles.assert_equal(agent, states[0].agent)
    assert "1200 is damaged (its seal is broken); the one of step 20 is used" in caplog.text
    assert (path / "1200").exists()  # reading changes nothing
    shutil.rmtree(path / "20")
    with pytest.raises(DamagedError, match="1200 is damaged"):
        Checkpoints(path).load_agent(trainer.shapes.agent)


def test_a_size_that_a_file_claims_is_not_allocated(trainer, states, tmp_path):
    """An array of 10^15 numbers in the metadata would end the process."""
    path = tmp_path / "checkpoints"
    Checkpoints(path, kept=2).save(states[0], {})
    huge = {"['a']": np.zeros(3, np.float32)}
    vast = tmp_path / "vast"
    with ocp.StandardCheckpointer() as checkpointer:
        checkpointer.save(vast.absolute(), huge)
    shutil.rmtree(path / "20" / "agent")
    shutil.copytree(vast, path / "20" / "agent")
    with pytest.raises(DamagedError, match="its arrays of agent are of other sizes"):
        Checkpoints(path).load(trainer.shapes)


def test_what_a_killed_process_left_is_removed(states, tmp_path):
    path = tmp_path / "checkpoints"
    checkpoints = Checkpoints(path, kept=2)
    for state in states:
        checkpoints.save(state, {})
    (path / "40.orbax-checkpoint-tmp").mkdir()
    checkpoints.drop_leftovers()
    checkpoints.drop_after(20)
    assert {folder.name for folder in path.iterdir()} == {"20"}
    assert checkpoints.newest() == 20
