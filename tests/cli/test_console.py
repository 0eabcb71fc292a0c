"""What all commands share on a terminal."""

import os
import subprocess
import sys

CODE = """
from mapg_jax.cli.console import own_stdout

with own_stdout() as out:
    print("said", file=out)
"""


def test_output_that_nobody_reads_is_no_error():
    """As of `mapg envs | head -1`."""
    read, write = os.pipe()
    os.close(read)
    ended = subprocess.run([sys.executable, "-c", CODE], stdout=write, stderr=subprocess.PIPE)
    os.close(write)
    assert (ended.returncode, ended.stderr) == (0, b"")
