"""Our environments among Gymnasium's: `mapg/Hopper-v5`, `mapg/Driving-v0`, …"""

import gymnasium

from envs import registry
from envs.registry import EnvSpec

NAMESPACE = "mapg"


def register() -> None:
    """Names every environment of ours to Gymnasium; nothing of JAX is imported.

    Called again, it adds those that have been registered with us since.
    """
    for spec in registry.loaded():
        if (id := gymnasium_id(spec)) not in gymnasium.registry:
            gymnasium.register(
                id,
                entry_point="envs.interop.gymnasium:SingleEnv",
                vector_entry_point="envs.interop.gymnasium:VectorEnv",
                max_episode_steps=spec.time_limit,
                kwargs={"name": spec.name},
            )


def gymnasium_id(spec: EnvSpec) -> str:
    """Gymnasium's own name and version where it has the task, else ours in its style."""
    if spec.gymnasium_id:
        return f"{NAMESPACE}/{spec.gymnasium_id}"
    words = spec.name.replace("-", "_").split("_")
    return f"{NAMESPACE}/{''.join(word[:1].upper() + word[1:] for word in words)}-v0"
