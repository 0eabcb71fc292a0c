"""The official score of a run, sealed together with what it is the score of."""

import hashlib
import json
from collections.abc import Mapping
from typing import Any

from mapg_jax.runs.folder import RunFolder, write_json
from mapg_jax.runs.metrics import rows_digest


def write_score(folder: RunFolder, record: Mapping[str, Any]) -> dict[str, Any]:
    """Writes the official score, sealed together with what it is the score of; gives it so."""
    sealed = {**record, "seal": _seal(folder, record)}
    write_json(folder.evaluation, sealed)
    return sealed


def refuse_a_broken_seal(folder: RunFolder, record: Mapping[str, Any]) -> None:
    """Raises ValueError if a score, its configuration or its metrics.csv was changed since."""
    unsealed = {name: value for name, value in record.items() if name != "seal"}
    expected, found = _seal(folder, unsealed), record.get("seal")
    if type(found) is not dict or found.get("score") != expected["score"]:
        raise ValueError(f"{folder.evaluation} is damaged: it is not what was written")
    for name, file in (("config", "config.json"), ("rows", "metrics.csv")):
        if found.get(name) != expected[name]:
            raise ValueError(f"{folder.path / file} is damaged: it is not that of the score")


def _seal(folder: RunFolder, record: Mapping[str, Any]) -> dict[str, str]:
    text = json.dumps(record, sort_keys=True)
    return {
        "score": hashlib.blake2b(text.encode(), digest_size=16).hexdigest(),
        "config": folder.digest,
        "rows": rows_digest(folder.metrics, int(record.get("env_steps", folder.config.steps))),
    }
