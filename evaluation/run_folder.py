"""The folder of a run. What stood there stays untouched until the new run has all its files."""

import os
import shutil
import tempfile
from pathlib import Path


class FolderError(ValueError):
    """A folder that cannot take a run. The message is one line."""


class RunFolder:
    """Gathers a run's files in a hidden folder beside their places, then moves them there.

    Args:
        target: the run's folder; made if it is not there.
    """

    def __init__(self, target: Path):
        self.target = target
        self._made = not target.exists()
        try:
            target.mkdir(parents=True, exist_ok=True)
            if taken := [p.name for p in target.iterdir() if is_run_file(p.name) and p.is_dir()]:
                raise FolderError(f"--out {target}: {taken[0]} is a folder")
            self.working = Path(tempfile.mkdtemp(prefix=".running-", dir=target))
        except (FileExistsError, NotADirectoryError):
            raise FolderError(f"--out {target}: a file is in the way") from None
        except OSError as error:
            raise FolderError(f"--out {target}: cannot be written ({error.strerror})") from None

    def publish(self) -> list[str]:
        """Replace an earlier run's files by the new ones; names of the new ones.

        The report goes first and comes last, so that no report ever stands beside another run's
        trajectories or recording. Files that no run writes are left alone.
        """
        new = sorted(p.name for p in self.working.iterdir() if p.name != "report.json")
        (self.target / "report.json").unlink(missing_ok=True)
        for old in self.target.iterdir():
            if old.is_file() and is_run_file(old.name) and old.name not in new:
                old.unlink()
        for name in [*new, "report.json"]:
            os.replace(self.working / name, self.target / name)
        self.working.rmdir()
        return ["report.json", *new]

    def discard(self) -> None:
        """Leave everything as it was found."""
        shutil.rmtree(self.working, ignore_errors=True)
        if self._made and not any(self.target.iterdir()):
            self.target.rmdir()


def is_run_file(name: str) -> bool:
    """Whether a file of this name is one that runs write."""
    return name in ("report.json", "error.txt") or name.endswith((".tum", ".rrd", ".log"))
