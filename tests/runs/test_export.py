"""Exported policies, in a process that has none of this package, propose what ours proposes."""

import json
import subprocess
import sys

import jax.numpy as jnp
import numpy as np
import pytest

from mapg_jax.runs.export import export
from mapg_jax.runs.policy import open_policy

OBSERVATIONS = np.random.default_rng(0).normal(size=(5, 3)).astype(np.float32)

PROGRAM = """
import jax
exported = jax.export.deserialize(bytearray(open("policy", "rb").read()))
assert exported.platforms == ("cpu", "cuda", "tpu")
proposals, values = exported.call(observations)
"""
ONNX = """
import onnxruntime
session = onnxruntime.InferenceSession("policy")
proposals, values = session.run(["proposals", "values"], {"observation": observations})
"""
WEIGHTS = """
import json
from safetensors.numpy import load_file
w, card = load_file("policy"), json.load(open("policy.json"))
actor = lambda name: w["learner.actor.params." + name]
variance = np.maximum(w["normalizer.deviations"] / w["normalizer.count"], 1e-2)
x = np.clip((observations - w["normalizer.mean"]) / np.sqrt(variance), -5, 5)
for layer in range(len(card["config"]["hidden"])):
    x = x @ actor(f"Dense_{layer}.kernel") + actor(f"Dense_{layer}.bias")
    x = (x - x.mean(-1, keepdims=True)) / np.sqrt(x.var(-1, keepdims=True) + 1e-6)
    norm = f"_Rectifier_{layer}.LayerNorm_0."
    x = np.maximum(x * actor(norm + "scale") + actor(norm + "bias"), 0)
heads = x @ actor("kernel") + actor("bias").reshape(-1)
proposals = np.tanh(heads)[:, :, None] * card["action_high"]  # one action dimension
"""


@pytest.fixture(scope="module")
def expected(finished_run):
    policy = open_policy(finished_run)
    proposals, values = policy.agent.proposals(policy.state, jnp.asarray(OBSERVATIONS))
    return np.asarray(proposals) * policy.env.action_high, np.asarray(values)


def elsewhere(program, folder):
    """What a program of a process without this package finds."""
    np.save(folder / "observations.npy", OBSERVATIONS)
    text = (
        "import sys, numpy as np\nobservations = np.load('observations.npy')\n"
        + program
        + "\nnp.save('proposals.npy', proposals)\n'values' in globals() and np.save('values.npy',"
        " values)\nassert 'mapg_jax' not in sys.modules"
    )
    subprocess.run([sys.executable, "-P", "-c", text], cwd=folder, check=True)
    return np.load(folder / "proposals.npy")


def test_the_program_proposes_the_same(finished_run, expected, tmp_path):
    export(finished_run.path, "stablehlo", tmp_path / "policy")
    np.testing.assert_allclose(elsewhere(PROGRAM, tmp_path), expected[0], rtol=1e-5, atol=1e-6)
    np.testing.assert_allclose(np.load(tmp_path / "values.npy"), expected[1], rtol=1e-5, atol=1e-5)


def test_the_weights_make_the_same_proposals(finished_run, expected, tmp_path):
    export(finished_run.path, "safetensors", tmp_path / "policy")
    np.testing.assert_allclose(elsewhere(WEIGHTS, tmp_path), expected[0], rtol=1e-4, atol=1e-5)


@pytest.mark.onnx
def test_onnx_proposes_the_same(finished_run, expected, tmp_path):
    export(finished_run.path, "onnx", tmp_path / "policy")
    np.testing.assert_allclose(elsewhere(ONNX, tmp_path), expected[0], rtol=1e-5, atol=1e-5)
    np.testing.assert_allclose(np.load(tmp_path / "values.npy"), expected[1], rtol=1e-5, atol=1e-5)


def test_the_card_says_what_the_numbers_mean(finished_run, tmp_path):
    _, card = export(finished_run.path, "stablehlo", tmp_path / "policy")
    record = json.loads(card.read_text())
    heads = finished_run.config.heads
    assert (record["observation"], record["proposals"]) == (["n", 3], ["n", heads, 1])
    assert record["action_high"] == [2.0] and record["env"] == "pendulum"
