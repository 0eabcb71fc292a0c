"""python -m mapg_jax is the command `mapg`."""

from mapg_jax.cli.main import main

main()
