# The extension module. Its callers check arguments and give them types: rasterizer.py, loss.py, adam_step.py.
from typing import Any

def __getattr__(name: str) -> Any: ...
