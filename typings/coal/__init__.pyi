# coal is a compiled module without stubs, in a path that pyright does not see; everything in it is untyped here.
from typing import Any

def __getattr__(name: str) -> Any: ...
