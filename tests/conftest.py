"""Each test worker compiles into a cache of its own: numba's is not safe for several writers."""

import os
from pathlib import Path

WORKER = os.environ.get("PYTEST_XDIST_WORKER", "main")
CACHE = Path(__file__).parent.parent / ".pytest_cache" / "numba" / WORKER
os.environ["NUMBA_CACHE_DIR"] = str(CACHE)
