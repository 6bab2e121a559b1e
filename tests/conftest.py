"""What must stand before any test module is imported."""

import os
from pathlib import Path

# A test may import mujoco before the plant does, which is when mujoco looks for its renderer.
os.environ.setdefault("MUJOCO_GL", "egl")

# Each test worker compiles into a cache of its own: numba's is not safe for several writers.
WORKER = os.environ.get("PYTEST_XDIST_WORKER", "main")
CACHE = Path(__file__).parent.parent / ".pytest_cache" / "numba" / WORKER
os.environ["NUMBA_CACHE_DIR"] = str(CACHE)
