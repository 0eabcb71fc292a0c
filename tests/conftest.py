"""What all tests share."""

import os
import tempfile

import flax.struct
import jax
import jaxlib.version
import pytest

# The import hook checks the arrays that functions take and return. Containers hold shapes, NumPy
# arrays and JAX's own placeholders too, so they are left alone: the hook honours this mark.
flax.struct.PyTreeNode.__no_type_check__ = True

# Programs compiled once serve every test of a session, in all of its processes, and the commands
# that tests start; the first process makes the folder, the others inherit its name.
if "PYTEST_XDIST_WORKER" not in os.environ:
    _cache = tempfile.TemporaryDirectory(prefix="mapg-tests-")
    os.environ["JAX_COMPILATION_CACHE_DIR"] = _cache.name
# What tests run is small, and most of their time goes into compiling it: here by XLA's older
# emitters, unoptimised, in a fifth of the time. jaxlib 0.12 has the newer ones alone, which at
# level 0 have made NaN of numbers that levels 1 and 3 agree on.
os.environ.setdefault(
    "XLA_FLAGS",
    "--xla_backend_optimization_level=0 --xla_cpu_use_fusion_emitters=false"
    if jaxlib.version.__version_info__ < (0, 11)
    else "--xla_backend_optimization_level=1",
)
os.environ.setdefault("NPROC", "1")  # XLA threads a process: the processes already fill the cores
jax.config.update("jax_compilation_cache_dir", os.environ["JAX_COMPILATION_CACHE_DIR"])
jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.2)
jax.config.update("jax_numpy_rank_promotion", "raise")  # [N] and [N, 1] never make an [N, N]


@pytest.fixture
def their_code():
    """For tests that trace the code of MJX or Brax, which broadcast as they like."""
    with jax.numpy_rank_promotion("allow"):
        yield


@pytest.fixture(scope="session")
def finished_run(tmp_path_factory):
    """The folder of oracles.RUN, all of its checkpoints kept and its policy not scored.

    A test that writes takes a copy.
    """
    import oracles

    from mapg_jax.runs.train import begin  # once the hook and the mark above are in place

    run = begin(oracles.RUN, tmp_path_factory.mktemp("runs") / "pendulum")
    run.go()
    return run.folder


@pytest.fixture
def browser():
    """Debian's Chromium, without a screen; it finds this machine alone, and no name."""
    from selenium import webdriver

    options = webdriver.ChromeOptions()
    options.binary_location = "/usr/bin/chromium"
    for flag in ("--headless", "--no-sandbox", "--disable-gpu", "--no-first-run",
                 "--disable-background-networking", "--window-size=1400,1200",
                 "--host-resolver-rules=MAP * ~NOTFOUND, EXCLUDE 127.0.0.1"):  # fmt: skip
        options.add_argument(flag)
    options.set_capability("goog:loggingPrefs", {"browser": "ALL"})
    service = webdriver.ChromeService("/usr/bin/chromedriver")
    driver = webdriver.Chrome(options, service)
    yield driver
    driver.quit()
