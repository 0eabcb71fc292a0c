"""A host function called from a program, through XLA's interface and through pure_callback."""

import concurrent.futures
import functools
import itertools
import os
import subprocess
import sys
import textwrap

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from envs.engines import host_call as module
from envs.engines.host_call import host_call

VECTOR = jax.ShapeDtypeStruct((3,), np.float32)
SCALAR = jax.ShapeDtypeStruct((), np.float32)
numbers = itertools.count()


@pytest.fixture(params=["foreign", "callback"])
def call(request, monkeypatch):
    """call(function, result, *arguments), the one way or the other, under a name of its own."""
    if request.param == "callback":
        monkeypatch.setattr(module, "interface_is_known", lambda: False)
    name = f"test-{next(numbers)}"
    return functools.partial(host_call, name=name)


def double_and_sum(x, y):
    return x * 2 + y, x.sum(-1)


def program(call):
    return lambda x, y: call(double_and_sum, (VECTOR, SCALAR), x, y)


def assert_doubled_and_summed(got, x, y):
    expected = double_and_sum(np.asarray(x), np.asarray(y))
    jax.tree.map(np.testing.assert_array_equal, got, expected)
    assert [x.dtype for x in got] == [np.float32, np.float32]


def run_python(code: str, **environment: str) -> str:
    """What a new process prints; it loads host_call alone, which imports nothing of `envs`."""
    load = f"""
        import importlib.util, os, sys
        spec = importlib.util.spec_from_file_location("host_call", {module.__file__!r})
        host_call = importlib.util.module_from_spec(spec)
        spec.loader.exec_module(host_call)
        import jax, jax.numpy as jnp, numpy as np
    """
    return subprocess.run(
        [sys.executable, "-c", textwrap.dedent(load) + textwrap.dedent(code)],
        env=os.environ | environment, check=True, stdout=subprocess.PIPE, text=True,
    ).stdout  # fmt: skip


def test_this_version_of_the_interface_is_known():
    """A new jax falls back to pure_callback, right but slow, until its header has been read."""
    assert module.interface_is_known()


def test_the_way_is_chosen_by_name_and_version(monkeypatch, tmp_path):
    def lowered(name):
        f = lambda x: host_call(lambda x: (x,), (VECTOR,), x, name=name)  # noqa: E731
        return jax.jit(f).lower(jnp.zeros(3)).as_text()

    assert "host_call:way" in lowered("way")
    assert "python_cpu_callback" in lowered(None)
    monkeypatch.setattr(jax.ffi, "include_dir", lambda: str(tmp_path))
    header = tmp_path / "xla/ffi/api/c_api.h"
    header.parent.mkdir(parents=True)
    versions = [None, (0, 2), (0, 3), (0, 5), (0, 6), (1, 3)]
    for version, known in zip(versions, [False, False, True, True, False, False], strict=True):
        if version is not None:
            major, minor = version
            header.write_text(
                f"#define XLA_FFI_API_MAJOR {major}\n#define XLA_FFI_API_MINOR {minor}\n"
            )
        module.interface_is_known.cache_clear()
        try:
            assert module.interface_is_known() == known
            assert ("python_cpu_callback" in lowered("way")) != known
        finally:
            module.interface_is_known.cache_clear()


def test_it_computes_under_jit_and_nested_batches_of_any_size(call):
    f = program(call)
    x, y = np.random.default_rng(0).normal(size=(2, 4, 5, 3)).astype(np.float32)
    assert_doubled_and_summed(f(x[0, 0], y[0, 0]), x[0, 0], y[0, 0])
    assert_doubled_and_summed(jax.jit(f)(x[0, 0], y[0, 0]), x[0, 0], y[0, 0])
    for size in (0, 1, 5):
        got = jax.jit(jax.vmap(f))(x[0, :size], y[0, :size])
        assert_doubled_and_summed(got, x[0, :size], y[0, :size])
    assert_doubled_and_summed(jax.jit(jax.vmap(jax.vmap(f)))(x, y), x, y)
    shared = jax.jit(jax.vmap(f, in_axes=(0, None)))(x[0], y[0, 0])
    assert_doubled_and_summed(shared, x[0], np.broadcast_to(y[0, 0], x[0].shape))


@pytest.mark.parametrize("dtype", [bool, np.uint8, np.int32, np.uint32, np.float16, jnp.bfloat16])
def test_numbers_of_every_kind_pass_as_they_are(call, dtype):
    x = np.arange(6).reshape(2, 3).astype(dtype)
    result = (jax.ShapeDtypeStruct((3, 2), dtype), jax.ShapeDtypeStruct((0,), dtype))
    got, empty = jax.jit(lambda x: call(lambda x: (x.T, x[:0, 0]), result, x))(x)
    np.testing.assert_array_equal(got, x.T)
    assert got.dtype == empty.dtype == dtype
    assert empty.shape == (0,)


def test_it_runs_in_a_loop_over_donated_state(call):
    step = lambda _, x: call(lambda x: (x + 1,), (VECTOR,), x)[0]  # noqa: E731
    run = jax.jit(lambda x: jax.lax.fori_loop(0, 100, step, x), donate_argnums=0)
    x = jnp.arange(3.0)
    for _ in range(3):
        x = run(x)
    np.testing.assert_array_equal(x, [300, 301, 302])


def test_programs_of_several_threads_call_it_at_once(call):
    step = lambda _, x: call(lambda x: (x + 1,), (VECTOR,), x)[0]  # noqa: E731
    run = jax.jit(lambda x: jax.lax.fori_loop(0, 50, step, x))
    with concurrent.futures.ThreadPoolExecutor(4) as pool:
        results = list(pool.map(lambda i: np.asarray(run(jnp.full(3, float(i)))), range(8)))
    np.testing.assert_array_equal(results, np.arange(8)[:, None] + np.full(3, 50))


def test_an_exception_reaches_whoever_runs_the_program(call):
    def fail(x):
        if x[0] < 0:
            raise ValueError(f"ünable to take {x[0]}")
        return (x,)

    f = jax.jit(lambda x: call(fail, (VECTOR,), x)[0])
    with pytest.raises(jax.errors.JaxRuntimeError, match=r"ValueError: ünable to take -1\.0"):
        jax.block_until_ready(f(jnp.full(3, -1.0)))
    np.testing.assert_array_equal(f(jnp.ones(3)), np.ones(3))  # and the next run is a run


@pytest.mark.parametrize("wrong", [np.zeros(4, np.float32), np.zeros(3, np.float64), np.zeros(1)])
def test_a_result_of_another_shape_or_type_is_refused(wrong):
    f = jax.jit(lambda x: host_call(lambda x: (wrong,), (VECTOR,), x, name=f"{next(numbers)}"))
    with pytest.raises(jax.errors.JaxRuntimeError, match=r"result 0 must be float32 \(3,\), got"):
        jax.block_until_ready(f(jnp.zeros(3)))


def test_an_argument_cannot_be_written():
    def write(x):
        x[0] = 1
        return (x,)

    f = jax.jit(lambda x: host_call(write, (VECTOR,), x, name="write"))
    with pytest.raises(jax.errors.JaxRuntimeError, match="read-only"):
        jax.block_until_ready(f(jnp.zeros(3)))


def test_every_shard_calls_it_with_its_part():
    printed = run_python("""
        mesh = jax.make_mesh((4,), ("n",))
        spec = jax.P("n")
        x = jax.device_put(jnp.arange(24.0).reshape(8, 3), jax.NamedSharding(mesh, spec))
        result = (jax.ShapeDtypeStruct((), np.float32),)
        for name in ("sum", None):
            shapes = []
            def total(x):
                shapes.append(x.shape)
                return (x.sum(-1),)
            one = lambda x: host_call.host_call(total, result, x, name=name)[0]
            f = jax.jit(jax.shard_map(jax.vmap(one), mesh=mesh, in_specs=spec, out_specs=spec))
            np.testing.assert_array_equal(f(x), np.arange(24.0).reshape(8, 3).sum(-1))
            print(shapes)
        """, JAX_NUM_CPU_DEVICES="4", JAX_COMPILATION_CACHE_DIR="")  # fmt: skip
    assert printed.splitlines() == [str([(2, 3)] * 4)] * 2


def test_a_cached_program_calls_the_function_of_its_own_process(tmp_path):
    code = """
        factor = np.float32(os.environ["FACTOR"])
        jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)
        hits = []
        jax.monitoring.register_event_listener(
            lambda event, **_: hits.append(event) if event.endswith("/cache_hits") else None
        )
        def f(x):
            result = (jax.ShapeDtypeStruct((), np.float32),)
            return host_call.host_call(lambda x: (factor * x,), result, x, name="times")[0]
        x = np.ones(2, np.float32)
        print(jax.jit(jax.vmap(f))(x), len(hits))
    """
    run = functools.partial(run_python, code, JAX_COMPILATION_CACHE_DIR=str(tmp_path))
    assert run(FACTOR="2") == "[2. 2.] 0\n"
    assert run(FACTOR="3") == "[3. 3.] 1\n"
