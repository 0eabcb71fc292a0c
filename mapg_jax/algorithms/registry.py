"""Algorithms by name: ours, a user's, and those of installed packages."""

import importlib.metadata
import re
from typing import Any

from mapg_jax.algorithms.a3c import A3c
from mapg_jax.algorithms.base import Algorithm
from mapg_jax.algorithms.mapg import Mapg
from mapg_jax.algorithms.naf import Naf
from mapg_jax.algorithms.ppo import Ppo
from mapg_jax.algorithms.sac import Sac
from mapg_jax.algorithms.td3 import Td3
from mapg_jax.algorithms.trpo import Trpo

GROUP = "mapg_jax.algorithms"
"""Of the entry points by which a package offers algorithms: a name, and the class."""

_ALGORITHMS: dict[str, type[Algorithm]] = {
    "mapg": Mapg,
    "a3c": A3c,
    "td3": Td3,
    "sac": Sac,
    "naf": Naf,
    "ppo": Ppo,
    "trpo": Trpo,
}
# What is read of it has an inferred type, type[Algorithm]: tests check what is annotated, and the
# class of a protocol with attributes cannot be checked.


def register(name: str, algorithm: Any) -> None:
    """Makes an algorithm known under a name, in this process; see `base.Algorithm`.

    Raises:
      ValueError: if another has the name or the slug, it is no plain name, or something is missing.
    """
    if not re.fullmatch(r"[a-z][a-z0-9_-]*", name):
        raise ValueError(f"an algorithm's name is of a-z, 0-9, _ and -, got {name!r}")
    if _ALGORITHMS.get(name, algorithm) is not algorithm:
        raise ValueError(f"there is another algorithm {name!r}")
    if lacking := [part for part in _parts() if not hasattr(algorithm, part)]:
        raise ValueError(f"the algorithm {name!r} lacks {', '.join(lacking)}")
    if "uniform" not in algorithm.selects:
        raise ValueError(f"the algorithm {name!r} needs uniform among its selects: it is scored so")
    for other, known in _ALGORITHMS.items():
        if other != name and (shared := _slugs(algorithm) & _slugs(known)):
            raise ValueError(f"the algorithm {name!r} has the slug {shared.pop()!r} of {other!r}")
    _ALGORITHMS[name] = algorithm


def names() -> tuple[str, ...]:
    """The algorithms there are; those of installed packages come last."""
    return tuple(dict.fromkeys([*_ALGORITHMS, *(point.name for point in _offered())]))


def find(name: str):
    """The algorithm of that name.

    Raises:
      ValueError: if there is none, or the package that offers it cannot be used.
    """
    if name not in _ALGORITHMS:
        offered = {point.name: point for point in _offered()}
        if name not in offered:
            raise ValueError(f"algorithm must be one of {', '.join(names())}, got {name!r}")
        try:
            register(name, offered[name].load())
        except Exception as error:  # of somebody else's code
            package = getattr(offered[name].dist, "name", offered[name].value)
            raise ValueError(f"the algorithm {name!r} of {package} is broken: {error}") from error
    return _ALGORITHMS[name]


def of_slug(slug: str, heads: int):
    """The algorithm that has that name in results.

    Raises:
      ValueError: if there is none.
    """
    for name in names():
        if (algorithm := find(name)).slug(heads) == slug:
            return algorithm
    raise ValueError(f"no algorithm with M = {heads} is called {slug!r}")


def name_of(algorithm: Any) -> str:
    """The name by which an algorithm is registered."""
    return next(name for name, known in _ALGORITHMS.items() if known is algorithm)


def _slugs(algorithm: Any) -> set[str]:
    """Of one action and of several."""
    return {algorithm.slug(heads) for heads in (1, 2)}


def _offered() -> importlib.metadata.EntryPoints:
    return importlib.metadata.entry_points(group=GROUP)


def _parts() -> set[str]:
    """What the protocol asks for."""
    methods = {name for name in vars(Algorithm) if not name.startswith("_")}
    return methods | set(Algorithm.__annotations__)
