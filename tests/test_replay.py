"""A recorded run, replayed where no simulator is, gives the same commands to the bit."""

import subprocess
import sys
from pathlib import Path

import pytest

from twin.cli import main

# Docked within sight of the belt, so that a short run gets to pick.
NEAR = ["site.dock=[4.0,1.2,1.5707963]", "site.pick_approach=[4.0,1.2,1.5707963]"]
SECONDS = 10

REPLAY = """
import sys

sys.modules.update(mujoco=None, dm_control=None, rerun=None)
from pathlib import Path

from twin.recording.codec import same
from twin.recording.log import read_config, read_log
from twin.stack.stack import Stack

path = Path(sys.argv[1])
stack = Stack(read_config(path, path.parent / "maps"))
ticks = moved = detected = 0
for tick in read_log(path):
    commands = stack.step(tick.stamp, tick.readings)
    if not same(commands, tick.commands):
        sys.exit(f"commands differ at {tick.stamp:.2f} s:\\n{commands}\\n{tick.commands}")
    ticks += 1
    moved += any(tick.commands.body_velocity.as_array())
    detected += bool(stack.state.detections)
print(ticks, moved, detected)
"""


@pytest.fixture(scope="module")
def recorded(tmp_path_factory) -> Path:
    out = tmp_path_factory.mktemp("run") / "out"
    run = ["run", "pick_line", "--log", "--duration", str(SECONDS), "--out", str(out)]
    assert main([*run, "--set", *NEAR]) == 1
    assert not (out / "error.txt").exists(), (out / "error.txt").read_text()
    return out


def replay(out: Path) -> tuple[int, int, int]:
    """Ticks that gave the same commands, ticks that moved, ticks that detected."""
    run = [sys.executable, "-c", REPLAY, str(out / "readings.log")]
    done = subprocess.run(run, capture_output=True, text=True)
    assert done.returncode == 0, done.stdout + done.stderr
    ticks, moved, detected = map(int, done.stdout.split())
    return ticks, moved, detected


def test_replay_gives_the_same_commands(recorded):
    ticks, moved, detected = replay(recorded)
    assert ticks == SECONDS * 100
    assert moved > 100 and detected > 100  # the log has something to say


@pytest.mark.slow
def test_replay_begins_with_the_belief_of_the_run(tmp_path):
    """Expected: `mapping`, whose depth camera is drawn wrong, calibrates it alike (at 13.8 s)."""
    assert main(["run", "mapping", "--log", "--duration", "16", "--out", str(tmp_path)]) == 1
    ticks, moved, _ = replay(tmp_path)
    assert ticks == 1600 and moved > 500
