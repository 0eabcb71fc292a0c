"""Packages of others that have the names of ours: `envs` and `experiments` are common ones."""

import importlib.util
import pathlib


def refuse(*names: str) -> None:
    """Raises ImportError where another package of a name would be imported than the one beside us.

    Args:
      names: packages that are installed together with this one.
    """
    for name in names:
        spec = importlib.util.find_spec(name)
        found = spec and (spec.submodule_search_locations or [spec.origin])[0]
        ours = pathlib.Path(__file__).resolve().parent.with_name(name)
        if found and pathlib.Path(found).resolve() != ours:
            raise ImportError(
                f"{found} is imported in place of mapg-jax's own package {name!r}: rename it, or "
                f"take {pathlib.Path(found).parent} off Python's path (the folder of a script or "
                "of `python -m`, PYTHONPATH, what is installed)"
            )
