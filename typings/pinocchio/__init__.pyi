# The library is compiled and has no stubs of its own.
from typing import Any

def __getattr__(name: str) -> Any: ...
