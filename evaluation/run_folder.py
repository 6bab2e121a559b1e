"""The folder of a run. What stood there stays untouched until the new run has all its files."""

import json
import os
import shutil
import tempfile
from pathlib import Path

REPORT = "report.json"


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
            if (target / REPORT).is_dir():
                raise FolderError(f"--out {target}: {REPORT} is a folder")
            self._earlier = _files_of(target)
            self.working = Path(tempfile.mkdtemp(prefix=".running-", dir=target))
        except (FileExistsError, NotADirectoryError):
            raise FolderError(f"--out {target}: a file is in the way") from None
        except OSError as error:
            raise FolderError(f"--out {target}: cannot be written ({error.strerror})") from None

    @property
    def holds_a_run(self) -> bool:
        """Whether an earlier run's report stands there."""
        return (self.target / REPORT).is_file()

    def files(self) -> list[str]:
        """Names of the run's files so far, the report first."""
        return [REPORT, *sorted(p.name for p in self.working.iterdir() if p.name != REPORT)]

    def publish(self) -> None:
        """Replace an earlier run's files by the new ones.

        The report goes first and comes last, so that no report ever stands beside another run's
        trajectories or recording. Only what the earlier report lists as its files is removed.
        """
        new = self.files()
        for name in [REPORT, *self._earlier]:
            (self.target / name).unlink(missing_ok=True)
        for name in [*new[1:], REPORT]:
            os.replace(self.working / name, self.target / name)
        self.working.rmdir()

    def discard(self) -> None:
        """Leave everything as it was found."""
        shutil.rmtree(self.working, ignore_errors=True)
        if self._made and not any(self.target.iterdir()):
            self.target.rmdir()


def _files_of(folder: Path) -> list[str]:
    """Files that the report in a folder says are its run's own; none if it says nothing."""
    try:
        listed = json.loads((folder / REPORT).read_text(encoding="utf-8"))["files"]
    except (OSError, ValueError, KeyError, TypeError):
        return []
    names = [n for n in listed if isinstance(n, str) and n not in (".", "..") and Path(n).name == n]
    return [n for n in names if (folder / n).is_file()]
