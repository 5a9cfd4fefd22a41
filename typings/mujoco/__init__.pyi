# MuJoCo's wheel ships its API as compiled modules without stubs; everything in it is untyped here.
from typing import Any

def __getattr__(name: str) -> Any: ...
