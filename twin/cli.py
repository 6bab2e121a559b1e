"""The `twin` command: `twin list`, `twin run NAME` and `twin train-detector`.

Exit codes: 0 the run met its criteria, 1 it fell short or was cut short, 2 bad input.
"""

import ast
import contextlib
import importlib
import importlib.util
import math
import os
import pkgutil
import signal
import sys
import traceback
from collections.abc import Sequence
from pathlib import Path

from rich.console import Console
from rich.markup import escape
from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn

from evaluation.report import build_report, report_table, verdict, write_report
from evaluation.run import RunRequest, RunResult
from evaluation.run_folder import FolderError, RunFolder
from twin.arguments import InputError, List, Run, TrainDetector, parse
from twin.layout import Layout, LayoutError, load_layout
from twin.recording.tum import write_tum

NOTES = 8  # of the last are printed


def main(argv: Sequence[str] | None = None, package: str = "scenarios") -> int:
    """Run the command line and return its exit code.

    Args:
        argv: arguments, without the program's name; the process's own without any.
        package: package whose modules are the scenarios.
    """
    try:
        with _interruptible():
            command = parse(sys.argv[1:] if argv is None else argv)
            if isinstance(command, List):
                _list(package)
                return 0
            if isinstance(command, TrainDetector):
                return _train(command)
            return _run(command, package)
    except (InputError, LayoutError, FolderError, OSError) as error:
        print(f"twin: {_one_line(error)}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        print("twin: interrupted", file=sys.stderr)
        return 1
    except SystemExit as leave:  # --help
        return int(leave.code or 0)


def scenario_files(package: str) -> dict[str, Path]:
    """Scenarios of a package: name to source file. A leading underscore hides a module."""
    spec = importlib.util.find_spec(package)
    places = (spec.submodule_search_locations if spec else None) or []
    found = {m.name for m in pkgutil.iter_modules(places) if not m.name.startswith("_")}
    return {n: p / f"{n}.py" for n in sorted(found) for p in map(Path, places)}


def description(source: Path) -> str:
    """First line of a module's docstring, read without importing it."""
    docstring = ast.get_docstring(ast.parse(source.read_text(encoding="utf-8")))
    return (docstring or "").partition("\n")[0]


def _list(package: str) -> None:
    files = scenario_files(package)
    width = max(map(len, files), default=0)
    for name, source in files.items():
        print(f"{name:{width}}  {description(source)}")


def _run(asked: Run, package: str) -> int:
    known = scenario_files(package)
    if asked.name not in known:
        raise InputError(f"no scenario '{asked.name}'; choose from {', '.join(known)}")
    _check(asked)
    layout = load_layout(asked.layout, asked.set)
    folder = RunFolder(asked.out or Path("runs") / f"{asked.name}-seed{asked.seed}")
    try:
        with _progress() as progress:
            request = RunRequest(
                seed=asked.seed,
                out=folder.working,
                duration=asked.duration,
                record=asked.record,
                log=asked.log,
                viewer=asked.viewer,
                progress=progress,
            )
            result = _result(f"{package}.{asked.name}", request, layout)
        # From here on only files are written: too short to be interrupted, too dear to be lost.
        _on_interrupt(signal.SIG_IGN)
        if result.sim_time == 0.0 and _interrupted and folder.holds_a_run:
            raise KeyboardInterrupt  # nothing was measured: the earlier run is worth more
        for name, (stamps, poses) in result.trajectories.items():
            write_tum(folder.working / f"{name}.tum", stamps, poses)
        files = folder.files()
        report = build_report(asked.name, request, layout, result, files)
        write_report(folder.working / "report.json", report)
        folder.publish()
    except BaseException:
        folder.discard()
        raise
    console = Console()
    console.print(report_table(report))
    for note in result.notes[-NOTES:]:
        console.print(escape(note), soft_wrap=True)
    if len(result.notes) > NOTES:
        console.print(f"({len(result.notes) - NOTES} earlier notes are in report.json)")
    console.print(escape(verdict(report)), soft_wrap=True)
    console.print(escape(f"files in {folder.target}: {', '.join(files)}"), soft_wrap=True)
    return 0 if report["passed"] else 1


def _train(asked: TrainDetector) -> int:
    from twin.training.command import train_detector  # the one command that needs all of it

    with _progress(unit="") as progress:
        network = train_detector(asked, load_layout(), progress)
    print(f"network and card in {network}; copy them to models/detector to use them")
    return 0


def _result(module: str, request: RunRequest, layout: Layout) -> RunResult:
    """Run a scenario; whatever breaks it off, there is something to report.

    A scenario that is interrupted in its loop returns what it has measured so far. Here only what
    it could not handle itself ends up: an interrupt while it builds, or a failure.
    """
    try:
        return importlib.import_module(module).run(request, layout)
    except KeyboardInterrupt:
        return RunResult(notes=["interrupted before anything was measured"])
    except (LayoutError, InputError):
        raise
    except Exception as error:
        if _interrupted:  # an import or a library turned the interrupt into an error of its own
            return RunResult(notes=["interrupted before anything was measured"])
        (request.out / "error.txt").write_text(traceback.format_exc(), encoding="utf-8")
        what = f"{type(error).__name__}: {_one_line(error)}"
        return RunResult(notes=[f"the run failed: {what} (error.txt says where)"])


def _check(asked: Run) -> None:
    if asked.seed < 0:
        raise InputError(f"--seed {asked.seed}: must be 0 or greater")
    if asked.duration is not None and not 0 < asked.duration < math.inf:
        raise InputError(f"--duration {asked.duration}: must be a positive number of seconds")
    displays = any(os.environ.get(v) for v in ("DISPLAY", "WAYLAND_DISPLAY"))
    if asked.viewer and sys.platform == "linux" and not displays:
        raise InputError("--viewer: no display here (neither DISPLAY nor WAYLAND_DISPLAY is set)")


@contextlib.contextmanager
def _progress(unit: str = "s"):
    """Progress bar on the terminal; yields the callable of `RunRequest.progress`."""
    console = Console(stderr=True)
    columns = (TextColumn("{task.description}"), BarColumn(), TimeElapsedColumn())
    with Progress(*columns, console=console, disable=not console.is_terminal) as bar:
        task = bar.add_task("starting", total=None)

        def progress(sim_time: float, total: float, text: str) -> None:
            about = f"{sim_time:6.1f} {unit}  {escape(text)}"
            bar.update(task, completed=sim_time, total=max(total, sim_time), description=about)

        yield progress


_interrupted: list[int] = []  # the signal that has interrupted us, if any


def _interrupt_once(number: int, frame) -> None:
    """The first interrupt ends the run; another must not end the writing of what it measured."""
    _on_interrupt(signal.SIG_IGN)
    _interrupted.append(number)
    raise KeyboardInterrupt


@contextlib.contextmanager
def _interruptible():
    """SIGINT and SIGTERM raise KeyboardInterrupt, also where a shell has them ignored for us."""
    signals = (signal.SIGINT, signal.SIGTERM)
    before = [signal.getsignal(s) for s in signals]
    _interrupted.clear()
    _on_interrupt(_interrupt_once)
    try:
        yield
    finally:
        with contextlib.suppress(ValueError):
            for number, handler in zip(signals, before, strict=True):
                signal.signal(number, handler)


def _on_interrupt(handler) -> None:
    with contextlib.suppress(ValueError):  # raised outside the main thread
        signal.signal(signal.SIGINT, handler)
        signal.signal(signal.SIGTERM, handler)


def _one_line(error: BaseException) -> str:
    return " ".join(str(error).split())
