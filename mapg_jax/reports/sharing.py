"""A trained policy as a small folder with a model card, given to others and taken from them.

What is given is a run folder still: its policy can be scored, watched and exported, not trained.
"""

import contextlib
import json
import os
import pathlib
import shutil
import tempfile
from typing import Any, Protocol, runtime_checkable

import yaml

from mapg_jax.reports.document import Block, Bullets, Heading, Paragraph, Table, markdown
from mapg_jax.reports.live_runs import newest_video
from mapg_jax.reports.results import settings
from mapg_jax.runs.checkpoints import Checkpoints
from mapg_jax.runs.folder import RunFolder, create_folder, is_blank
from mapg_jax.runs.policy import open_policy

CARD = "README.md"
LARGEST_VIDEO = 10_000_000  # bytes
PARTS = ("agent", "host")
"""Of a checkpoint: what a policy needs, and its seal."""
WRITTEN = "commit_success.txt"
"""Orbax's note that a part is whole."""


@runtime_checkable
class Hub(Protocol):
    """Where policies are kept under names."""

    def send(self, folder: pathlib.Path, name: str) -> str:
        """Keeps the files of a folder; gives where they are."""
        ...

    def fetch(self, name: str, into: pathlib.Path) -> None:
        """Copies the files kept under a name into a new folder."""
        ...


class SharedFolder:
    """A folder as a hub: a name is a path."""

    def send(self, folder: pathlib.Path, name: str) -> str:
        place = pathlib.Path(name)
        _refuse_to_overwrite(place)
        shutil.copytree(folder, place, dirs_exist_ok=True)
        return name

    def fetch(self, name: str, into: pathlib.Path) -> None:
        if not pathlib.Path(name).is_dir():
            raise ValueError(f"there is no folder {name}")
        shutil.copytree(name, into, symlinks=True, dirs_exist_ok=True)


class HuggingFace:
    """The Hugging Face Hub: a name is USER/NAME; its own configuration says whose account it is."""

    def send(self, folder: pathlib.Path, name: str) -> str:
        api = _hugging_face().HfApi()
        with _asking(name):
            address = api.create_repo(name, exist_ok=True)
            api.upload_folder(repo_id=name, folder_path=folder)
        return str(address)

    def fetch(self, name: str, into: pathlib.Path) -> None:
        with _asking(name):
            _hugging_face().snapshot_download(name, local_dir=into)


def hub_of(name: str) -> Hub:
    """A folder where the name is a path, which begins with `/`, `.` or `~`; else Hugging Face."""
    return SharedFolder() if name.startswith(("/", ".", "~")) else HuggingFace()


def push(path: str | os.PathLike, name: str) -> str:
    """Gives the newest policy of a run to others; gives where it is.

    Args:
      path: the run folder.
      name: of `hub_of`.

    Raises:
      ValueError: if the run has no policy or no score, or the hub refuses.
    """
    with tempfile.TemporaryDirectory() as parent:
        folder = pathlib.Path(parent) / "policy"
        bundle(path, folder)
        return hub_of(name).send(folder, os.path.expanduser(name))


def pull(name: str, out: pathlib.Path) -> pathlib.Path:
    """Takes a policy of others; gives its folder.

    Args:
      name: of `hub_of`.
      out: a new folder.

    Raises:
      ValueError: if there is something in the folder, the hub refuses, or what it has is no policy.
    """
    _refuse_to_overwrite(out)
    made = not out.exists()
    try:
        hub_of(name).fetch(os.path.expanduser(name), out)
        shutil.rmtree(out / ".cache", ignore_errors=True)  # the hub's own notes
        open_policy(RunFolder.open(out))
    except BaseException:
        if made:
            shutil.rmtree(out, ignore_errors=True)
        raise
    return out


def bundle(path: str | os.PathLike, out: pathlib.Path) -> None:
    """The newest policy of a run as a folder of its own: small, sealed, with its model card.

    Raises:
      ValueError: if there is something in `out`, or the run has no policy or no score of it.
    """
    folder = RunFolder.open(path)
    policy = open_policy(folder)
    if folder.scored_steps() != policy.env_steps:
        raise ValueError(f"the newest policy has no score yet: mapg evaluate {folder.path}")
    _refuse_to_overwrite(out)
    create_folder(out)
    for name in ("config.json", "metrics.csv", "evaluation.json", "curve.png"):
        with contextlib.suppress(FileNotFoundError):
            shutil.copyfile(folder.path / name, out / name)
    step = str(Checkpoints(folder.checkpoints).newest())
    kept = out / "checkpoints" / step
    kept.mkdir(parents=True)
    for file in (folder.checkpoints / step).iterdir():
        if file.is_file():
            shutil.copyfile(file, kept / file.name)
        elif file.name in PARTS:
            shutil.copytree(file, kept / file.name)
    for file in kept.rglob(WRITTEN):  # it names the folder here, and nothing else
        file.write_text("")
    video = newest_video(folder)
    if video and video.stat().st_size <= LARGEST_VIDEO:
        shutil.copyfile(video, out / video.name)
    (out / CARD).write_text(card(RunFolder.open(out)), encoding="utf-8")


def card(folder: RunFolder) -> str:
    """The model card: what it does, how well, how it was made and how it is used, in Markdown."""
    config = folder.config
    score = json.loads(folder.evaluation.read_text())
    history = json.loads((folder.path / "config.json").read_text())["history"]
    title = f"{config.label} on {config.env}"
    low, high = score["ci95"]
    scored = [
        ["return, mean", f"{score['mean']:,.1f}"],
        ["95 % interval over episodes", f"{low:,.1f} to {high:,.1f}"],
        ["standard deviation over episodes", f"{score['std']:,.1f}"],
        ["episodes", f"{score['episodes']:,}"],
        ["head that acts", score["select"]],
        ["environment steps of training", f"{score['env_steps']:,}"],
    ]
    packages = history[-1]["packages"]
    made = [f"{entry['date']}: `{entry['command']}`" for entry in history]
    if score["env_steps"] < config.steps:
        made.append(f"stopped at {score['env_steps']:,} of {config.steps:,} steps")
    blocks: list[Block] = [
        Heading(title, 1),
        Paragraph(
            f"{config.heads} action{'s' if config.heads > 1 else ''} proposed for every state of "
            f"`{config.env}`, by {config.algorithm} (mapg-jax). One run, one seed "
            f"({config.seed}): the next one will differ by more than this interval."
        ),
        Table(("score", ""), scored),
        Heading("Use", 2),
        Bullets(
            (
                "`mapg evaluate FOLDER`, `mapg watch FOLDER`, `mapg export FOLDER`",
                "`mapg_jax.load_policy(FOLDER)` gives a function from observations to actions",
            )
        ),
        Heading("Made by", 2),
        Bullets(made),
        Paragraph(f"What differs from the preset `paper`: {settings(config) or 'nothing'}."),
        Heading("Versions", 2),
        Table(("package", "version"), [[name, str(v)] for name, v in packages.items()]),
        Paragraph("Licence: Apache-2.0."),
    ]
    shown = [f"![Episodes]({video.name})\n"] if (video := newest_video(folder)) else []
    return "\n".join([_front(folder, score, title), markdown(blocks), *shown])


def _front(folder: RunFolder, score: dict[str, Any], title: str) -> str:
    """What the hub reads, as YAML."""
    result = {
        "task": {"type": "reinforcement-learning", "name": "reinforcement-learning"},
        "dataset": {"name": folder.config.env, "type": folder.config.env},
        "metrics": [{"type": "mean_reward", "value": round(float(score["mean"]), 3)}],
    }
    head = {
        "library_name": "mapg-jax",
        "license": "apache-2.0",
        "tags": ["reinforcement-learning", folder.config.algorithm, folder.config.env],
        "model-index": [{"name": title, "results": [result]}],
    }
    return f"---\n{yaml.safe_dump(head, sort_keys=False)}---\n"


def _refuse_to_overwrite(out: pathlib.Path) -> None:
    if not is_blank(out):
        raise ValueError(f"{out} exists already; choose another folder")


def _hugging_face():
    try:
        import huggingface_hub  # pyright: ignore[reportMissingImports]
    except ImportError:
        raise ValueError(
            "the Hugging Face Hub needs: pip install 'mapg-jax[hub]'; a path (./folder) needs "
            "nothing"
        ) from None
    return huggingface_hub


@contextlib.contextmanager
def _asking(name: str):
    """What the hub says no to, as one line."""
    try:
        yield
    except OSError as error:  # its own errors are of this kind
        reason = str(error).strip().splitlines()
        raise ValueError(f"{name}: {reason[0] if reason else type(error).__name__}") from None
