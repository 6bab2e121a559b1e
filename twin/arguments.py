"""What can be asked of the `twin` command, and how it is read."""

import contextlib
import io
from collections.abc import Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Annotated

import tyro


class InputError(ValueError):
    """Something asked for that cannot be done. The message is one line."""


@dataclass(frozen=True)
class List:
    """List the scenarios."""


@dataclass(frozen=True)
class Run:
    """Run a scenario; report, trajectories and recording go to one folder."""

    name: Annotated[tyro.conf.Positional[str], tyro.conf.arg(metavar="NAME")]
    """Scenario; `twin list` names them."""
    seed: int = 0
    """Of the run's random generator: same seed, same run."""
    duration: float | None = None
    """Cut the run short after so many simulated seconds."""
    out: Path | None = None
    """Folder of the run's files. Default: runs/NAME-seedN."""
    record: bool = False
    """Write recording.rrd, for `rerun`."""
    log: bool = False
    """Write readings.log, for replay: up to 10 MB a simulated second."""
    viewer: bool = False
    """Open MuJoCo's viewer; needs a display."""
    layout: Path | None = None
    """Layout file in place of the default cell."""
    set: Annotated[tuple[str, ...], tyro.conf.UseAppendAction] = ()
    """Layout value as key=value: a dotted path or a short name such as belt_speed."""


@dataclass(frozen=True)
class TrainDetector:
    """Make the detector's pictures, train it and export it; resumes what is half done."""

    out: Path | None = None
    """Folder of pictures, checkpoints and the exported network. Default: runs/detector."""
    seed: int = 0
    """Of pictures and crops."""
    pictures: int = 8000
    """To draw; seven of ten are trained on."""
    steps: int = 6000
    """Of training the first look, 32 crops each."""
    look_steps: int = 12000
    """Of training the second look, 96 patches each."""
    ablation_steps: int = 0
    """Of each shorter training without one of the improvements; 0 leaves them out."""
    weights: Path | None = None
    """Folder of weights (npz) to begin with, such as models/detector."""


Command = (
    Annotated[List, tyro.conf.subcommand("list")]
    | Annotated[Run, tyro.conf.subcommand("run")]
    | Annotated[TrainDetector, tyro.conf.subcommand("train-detector")]
)


def parse(argv: Sequence[str]) -> List | Run | TrainDetector:
    """Parse arguments; tyro's boxed complaint becomes one line."""
    complaint = io.StringIO()
    try:
        with contextlib.redirect_stderr(complaint):
            return tyro.cli(
                Command,  # type: ignore[arg-type]
                prog="twin",
                description="Digital twin of a machining cell.",
                args=_repeat_set(argv),
                config=(tyro.conf.FlagCreatePairsOff,),
            )
    except SystemExit as leave:
        if not leave.code:
            raise
        raise InputError(_unbox(complaint.getvalue(), argv)) from None


def _unbox(box: str, argv: Sequence[str]) -> str:
    """The first statement of tyro's boxed complaint, and the choices there are, on one line.

    A terminal without box characters gets rules of dashes above and below, and no sides.
    """
    below_title = [line.strip("│╭╮╰╯|+ ") for line in box.splitlines()[1:]]
    statements: list[list[str]] = [[]]
    for line in below_title:
        if line and not line.strip("─-"):  # a rule
            statements.append([])
        elif line:
            statements[-1].append(line)
    said = " ".join(next((lines for lines in statements if lines), []))
    known = {"run": Run, "train-detector": TrainDetector}
    if argv and argv[0] in known:
        if said.startswith("Unrecognized"):
            options = [f.name.replace("_", "-") for f in fields(known[argv[0]]) if f.name != "name"]
            said += f"; choose from --{', --'.join(options)}"
        return f"{said}; see twin {argv[0]} --help"
    return f"{said.rstrip('.')}; choose from list, run, train-detector; see twin --help"


def _repeat_set(argv: Sequence[str]) -> list[str]:
    """`--set a=1 b=2` as `--set a=1 --set b=2`, which the parser understands."""
    out: list[str] = []
    for word in argv:
        after_value = len(out) > 1 and out[-2] == "--set"
        if after_value and "=" in word and not word.startswith("-"):
            out.append("--set")
        out.append(word)
    return out
