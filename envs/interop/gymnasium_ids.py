"""Our environments among Gymnasium's: `mapg/Hopper-v5`, `mapg/Driving-v0`, …"""

import gymnasium

from envs import registry

NAMESPACE = "mapg"


def register() -> None:
    """Names every environment of ours to Gymnasium; nothing of JAX is imported."""
    for name in registry.names():
        if (id := gymnasium_id(name)) not in gymnasium.registry:
            gymnasium.register(
                id,
                entry_point="envs.interop.gymnasium:SingleEnv",
                vector_entry_point="envs.interop.gymnasium:VectorEnv",
                max_episode_steps=registry.spec(name).time_limit,
                kwargs={"name": name},
            )


def gymnasium_id(name: str) -> str:
    """Gymnasium's own name and version where it has the task, else ours in its style."""
    if theirs := registry.spec(name).gymnasium_id:
        return f"{NAMESPACE}/{theirs}"
    words = name.replace("-", "_").split("_")
    return f"{NAMESPACE}/{''.join(word[:1].upper() + word[1:] for word in words)}-v0"
