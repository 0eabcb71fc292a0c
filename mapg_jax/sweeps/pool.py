"""Workers of a sweep: what each does, and what became of it."""

import pathlib
import sys

from mapg_jax.runs.finishing import is_finished
from mapg_jax.runs.folder import RunFolder, is_blank
from mapg_jax.sweeps.groups import Group, Job, at_work
from mapg_jax.sweeps.launchers import Launcher, Share
from mapg_jax.sweeps.worker import failure_file
from mapg_jax.training import plugins

WORKER = "mapg_jax.sweeps.worker"


class Worker:
    """A process that does one group, here or elsewhere."""

    def __init__(self, group: Group, share: Share, keep_replay: bool, launcher: Launcher):
        self.group, self.share = group, share
        self.folders = [_open(job) for job in at_work(group)]
        self._log = self.folders[0].path / "worker.log"
        flags = ["--keep-replay"] if keep_replay else []
        flags += [f"--idle={k}" for k, job in enumerate(group) if job.idle]
        folders = [str(job.path) for job in group]
        imports = [f"--import={module}" for module in plugins.loaded()]
        # -P: a folder `envs` in the working folder would be imported for ours.
        command = [sys.executable, "-P", "-m", WORKER, *flags, *imports, *folders]
        self.launched = launcher.start(command, self._log, share)
        self._status: int | None = None

    def running(self) -> bool:
        return self.launched.running()

    def stop(self) -> None:
        """Asks it to save and to end."""
        if self.running():
            self.launched.stop()

    def wait(self) -> None:
        """Until it has ended; from then on nothing of it is left."""
        self._status = self.launched.wait()

    def crashed(self) -> bool:
        """Whether it ended before it could say what became of its runs."""
        return self._status != 0

    def failures(self) -> dict[pathlib.Path, str]:
        """Why the runs that did not finish did not, once it has ended."""
        output = []
        if self._log.exists():
            output = self._log.read_text(errors="replace").strip().splitlines()
        code = self._status or 0
        ended = f"killed by signal {-code}" if code < 0 else f"exit status {code}"
        reason = f"{ended}; last output: {output[-1]}" if output else ended
        reasons = {}
        for folder in self.folders:
            if not is_finished(folder):
                file = failure_file(folder.path)
                if not file.exists():
                    file.write_text(f"{reason}\n")
                reasons[folder.path] = file.read_text().strip()
        return reasons


def _open(job: Job) -> RunFolder:
    """The folder of a run, new or gone on with, and this process written into its history."""
    if is_blank(job.path):
        return RunFolder.create(job.path, job.config)
    folder = RunFolder.open(job.path)
    failure_file(job.path).unlink(missing_ok=True)
    folder.write_config()
    return folder
