"""Our environments are registered with Gymnasium as soon as both are imported, in either order.

Importing Gymnasium takes longer than all that `mapg --help` does, so that it is not imported here.
"""

import importlib.abc
import importlib.machinery
import importlib.util
import sys


def with_gymnasium() -> None:
    """Registers now if Gymnasium is there, else when it is imported."""
    if "gymnasium" in sys.modules:
        _register()
    elif not any(isinstance(finder, _AfterGymnasium) for finder in sys.meta_path):
        sys.meta_path.insert(0, _AfterGymnasium())


def _register() -> None:
    from envs.interop import gymnasium_ids

    gymnasium_ids.register()


class _AfterGymnasium(importlib.abc.MetaPathFinder):
    """Sees Gymnasium being imported, once, and adds our names at its end."""

    def find_spec(self, fullname, path, target=None) -> importlib.machinery.ModuleSpec | None:
        if fullname != "gymnasium":
            return None
        sys.meta_path.remove(self)
        spec = importlib.util.find_spec(fullname)
        if spec and spec.loader:
            execute = spec.loader.exec_module

            def and_register(module):
                execute(module)
                _register()

            spec.loader.exec_module = and_register
        return spec
