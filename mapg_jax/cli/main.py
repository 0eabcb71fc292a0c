"""The door: `mapg COMMAND`."""

import contextlib
import importlib
import os
import pathlib
import signal
import sys
from typing import TYPE_CHECKING, TextIO

from mapg_jax import foreign
from mapg_jax.cli import completion
from mapg_jax.cli.console import complain, own_stdout, refuse_politely
from mapg_jax.training import plugins

if TYPE_CHECKING:
    from mapg_jax.cli.parser import Parser

COMMANDS = {
    "train": "Train a policy.",
    "sweep": "Train a grid of runs.",
    "search": "Look for hyper-parameters.",
    "resume": "Go on with a run, a sweep or a search, as if it had not stopped.",
    "evaluate": "Score a run's newest checkpoint.",
    "draw": "Draw one episode of a run, where its environment draws.",
    "export": "Write a policy that runs without this package.",
    "watch": "Film a run's newest policy, and what its heads propose.",
    "push": "Give a trained policy to others, with a model card.",
    "pull": "Take a policy of others.",
    "dashboard": "Follow runs on a page, while they go on.",
    "report": "Put finished runs side by side: tables with intervals over seeds, and pictures.",
    "paper": "Make a table or figure of the paper, and train the runs it lacks.",
    "envs": "List the environments.",
}
"""Each is a module of this folder with `parse(flags)` and `run(arguments, out)`."""


def main() -> None:
    """The command `mapg`."""
    # Networks of this size are too small to share among XLA's threads, which wait for each other:
    # one is faster and leaves the other cores to the physics. NPROC in the environment wins.
    os.environ.setdefault("NPROC", "1")
    if completion.ASKED in os.environ:
        completion.complete(COMMANDS)
    name, *flags = sys.argv[1:] or ["--help"]
    if name in ("-h", "--help"):
        print(_help(), end="")
        return
    if name not in COMMANDS:
        sys.exit(complain(f"unknown command {name!r}; known are {', '.join(COMMANDS)}", 2))
    try:
        foreign.refuse("envs", "experiments")
    except ImportError as error:
        sys.exit(complain(str(error), 2))
    with _ended_by_interrupts():
        command = refuse_politely(lambda: importlib.import_module(f"mapg_jax.cli.{name}"))
        arguments = refuse_politely(lambda: command.parse(flags))
    with own_stdout() as out:
        _run(command, arguments, out)


def parser(name: str, epilog: str = "") -> "Parser":
    """The parser of a command; modules of the user's own can be named on each."""
    from mapg_jax.cli.parser import Parser  # it reads values by `envs`, which may be another's

    command = Parser(prog=f"mapg {name}", description=COMMANDS[name], epilog=epilog)
    plugins.add_argument(command)
    return command


@contextlib.contextmanager
def _ended_by_interrupts():
    """Ctrl-C ends the process, without a word: modules that are being imported would tell all of
    where they are, or pass over it."""
    previous = signal.getsignal(signal.SIGINT)
    if previous is signal.default_int_handler:
        signal.signal(signal.SIGINT, signal.SIG_DFL)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, previous)


def _run(command, arguments, out: TextIO) -> None:
    import jax

    from mapg_jax.runs.member import DivergedError
    from mapg_jax.runs.signals import StoppedError, leave, leave_at_once

    jax.config.update("jax_compilation_cache_dir", str(_cache_folder()))
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.2)
    try:
        command.run(arguments, out)
    except DivergedError as error:
        sys.exit(complain(str(error), 1))
    except jax.errors.JaxRuntimeError as error:
        said = str(error).splitlines()[0]
        if "RESOURCE_EXHAUSTED" in said:
            sys.exit(complain(f"{said}; fewer environments or smaller batches need less", 1))
        if jax.process_count() == 1:
            raise
        out.flush()  # a score may be in it
        # An exit would wait for the one that is lost, and abort.
        remedy = "what is saved is whole, and goes on with mapg resume on all hosts"
        leave_at_once(complain(f"a process of this run is lost ({said}); {remedy}", 1))
    except KeyboardInterrupt:
        sys.exit(complain("interrupted", 130))
    except OSError as error:  # a full disk, say
        sys.exit(complain(str(error), 1))
    except StoppedError as error:
        leave(complain(str(error), 128 + error.number))


def _help() -> str:
    width = max(map(len, COMMANDS))
    lines = [f"  {name:{width}}  {text}" for name, text in COMMANDS.items()]
    return (
        "usage: mapg COMMAND …\n\n"
        "Policies with several actions a state. Each command has its own --help.\n\n"
        + "\n".join(lines)
        + "\n"
    )


def _cache_folder() -> pathlib.Path:
    """Compiled programs, kept between commands."""
    base = os.environ.get("XDG_CACHE_HOME") or pathlib.Path.home() / ".cache"
    return pathlib.Path(
        os.environ.get("JAX_COMPILATION_CACHE_DIR") or pathlib.Path(base) / "mapg-jax"
    )
