# The extension module of the peaks. bench.py gives its functions types and turns their errors into InputError.
from typing import Any

def __getattr__(name: str) -> Any: ...
