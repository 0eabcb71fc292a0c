"""What MuJoCo's bindings in C++ define has no types: to pyright it is Any."""

from typing import Any

def __getattr__(name: str) -> Any: ...
