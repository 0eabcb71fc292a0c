"""A policy that runs without this package: its program, or its weights, with a card in JSON."""

import json
import os
import pathlib
from collections.abc import Callable, Mapping
from typing import Any, Literal

import jax
import jax.numpy as jnp
import numpy as np

from mapg_jax.runs.folder import RunFolder, refuse_nowhere, this_process, values_of
from mapg_jax.runs.policy import Policy, open_policy

Format = Literal["stablehlo", "onnx", "safetensors"]
PLATFORMS = ("cpu", "cuda", "tpu")


def export(path: str | os.PathLike, form: Format, out: pathlib.Path) -> list[pathlib.Path]:
    """Writes the policy of a run's newest checkpoint; gives the files.

    The program takes observations f32 [N, D], as the environment gives them, to all proposals f32
    [N, M, A], in the environment's units, and the critic's value of each, f32 [N, M]. To act is to
    draw one of the M uniformly, or to take the one of the largest value.

    Args:
      path: the run folder.
      form: stablehlo (read by `jax.export.deserialize`), onnx, or safetensors: the weights alone.
      out: the file, whose folder must be there; the card lies beside it, as `out` + `.json`.

    Raises:
      ValueError: if there is no policy, the file exists, or what the format needs is not installed.
    """
    folder = RunFolder.open(path)
    policy = open_policy(folder)
    card = out.with_name(out.name + ".json")
    for file in (out, card):
        if file.exists():
            raise ValueError(f"{file} exists already; choose another --out")
    refuse_nowhere(out)
    try:
        content = WRITERS[form](policy)
    except ImportError as error:
        extra = "onnx" if form == "onnx" else "export"
        raise ValueError(
            f"--format {form} needs {error.name or 'a package'}: pip install 'mapg-jax[{extra}]'"
        ) from None
    out.write_bytes(content)
    card.write_text(json.dumps(_card(folder, policy, form), indent=2) + "\n")
    return [out, card]


def program(policy: Policy) -> Callable[[jax.Array], tuple[jax.Array, jax.Array]]:
    """Observations [N, D] → proposals [N, M, A] in the environment's units, and values [N, M]."""
    state = policy.state
    heads = int(policy.state.hyper.heads)
    high = np.broadcast_to(np.float32(policy.env.action_high), (1, 1, policy.env.action_size))

    def propose(observation: jax.Array) -> tuple[jax.Array, jax.Array]:
        proposals, values = policy.agent.proposals(state, observation)
        return proposals[..., :heads, :] * high, values[..., :heads]

    return propose


def _stablehlo(policy: Policy) -> bytes:
    import flatbuffers  # noqa: F401  # what JAX serialises by

    (n,) = jax.export.symbolic_shape("n")
    observation = jax.ShapeDtypeStruct((n, policy.env.observation_size), jnp.float32)
    exported = jax.export.export(jax.jit(program(policy)), platforms=PLATFORMS)(observation)
    return bytes(exported.serialize())


def _onnx(policy: Policy) -> bytes:
    import jax2onnx  # pyright: ignore[reportMissingImports]  # of the extra

    size = policy.env.observation_size
    model = jax2onnx.to_onnx(
        program(policy),
        [("N", size)],
        input_names=["observation"],
        output_names=["proposals", "values"],
    )
    return model.SerializeToString()


def _safetensors(policy: Policy) -> bytes:
    from safetensors import numpy

    return numpy.save(weights(policy))


def weights(policy: Policy) -> dict[str, np.ndarray]:
    """All arrays of the agent by their paths in its state, but those of optimisers."""
    found = {}
    for path, leaf in jax.tree_util.tree_leaves_with_path(policy.state):
        name = jax.tree_util.keystr(path, simple=True, separator=".")
        key = jnp.issubdtype(leaf.dtype, jax.dtypes.prng_key)
        if not key and not any(part.endswith("optimizer") for part in name.split(".")):
            found[name] = np.asarray(leaf)
    return found


WRITERS: Mapping[Format, Callable[[Policy], bytes]] = {
    "stablehlo": _stablehlo,
    "onnx": _onnx,
    "safetensors": _safetensors,
}


def _card(folder: RunFolder, policy: Policy, form: Format) -> dict[str, Any]:
    """What the file is of, and how its numbers are meant."""
    config, process = folder.config, this_process()
    score = json.loads(folder.evaluation.read_text()) if folder.evaluation.exists() else None
    return {
        "format": form,
        "observation": ["n", policy.env.observation_size],
        "proposals": ["n", int(policy.state.hyper.heads), policy.env.action_size],
        "values": ["n", int(policy.state.hyper.heads)],
        "action_high": np.broadcast_to(policy.env.action_high, (policy.env.action_size,)).tolist(),
        "act": "draw one of the proposals uniformly, or take the one of the largest value",
        "env": config.env,
        "algorithm": config.algorithm,
        "env_steps": policy.env_steps,
        "score": score and {name: score.get(name) for name in ("mean", "std", "episodes")},
        "config": values_of(config),
        "packages": process["packages"],
    }
