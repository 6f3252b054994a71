"""The decoder of plugins/c_decoder in this process, through ctypes: for tools and tests that compare decoders."""

from __future__ import annotations

import ctypes
import os
import shutil
import subprocess
from pathlib import Path
from typing import NamedTuple, Self

FOLDER = Path(__file__).parents[1] / "plugins" / "c_decoder"
SOURCES = sorted(path for path in (FOLDER / "src" / "c").glob("*.c") if not path.name.startswith("gss_"))
FLAGS = ("-std=c99", "-ffp-contract=off", "-fno-math-errno", "-O2")
FRAME, REFUSED = 1, -1


class _Frame(ctypes.Structure):
    """The head of gss_frame in gss.h: what its arrays are is not needed here."""

    _fields_ = [(name, ctypes.c_uint32) for name in ("frame", "rows", "nodes", "harmonics")]


class _Fault(ctypes.Structure):
    """gss_fault of gss.h."""

    _fields_ = [
        ("code", ctypes.c_int),
        ("rule", ctypes.c_char * 12),
        ("byte", ctypes.c_uint64),
        ("message", ctypes.c_char * 160),
    ]


class Fault(NamedTuple):
    """What ended a stream: the rule that is broken, the byte at which its packet begins, a sentence."""

    rule: str
    byte: int
    message: str


def compiler() -> str | None:
    """Return the C compiler of this machine, or None."""
    return shutil.which(os.environ.get("CC", "cc"))


class Library:
    """The decoder, compiled into a folder. Raises RuntimeError where it does not compile."""

    def __init__(self, folder: Path) -> None:
        built = folder / "libgss.so"
        command = [str(compiler()), *FLAGS, "-shared", "-fPIC", *map(str, SOURCES), "-lm", "-o", str(built)]
        done = subprocess.run(command, capture_output=True, text=True, timeout=300, check=False)
        if done.returncode:
            raise RuntimeError(f"the decoder in C does not compile: {done.stderr}")
        self.calls = ctypes.CDLL(str(built))
        self.calls.gss_open.restype = ctypes.c_void_p
        self.calls.gss_open.argtypes = (ctypes.c_char_p, ctypes.c_size_t, ctypes.c_size_t)
        self.calls.gss_state.restype = ctypes.POINTER(_Frame)
        self.calls.gss_error.restype = ctypes.POINTER(_Fault)
        self.calls.gss_hash.argtypes = (ctypes.c_void_p, ctypes.c_char_p)
        for name in ("gss_next", "gss_state", "gss_error", "gss_close"):
            getattr(self.calls, name).argtypes = (ctypes.c_void_p,)

    def open(self, data: bytes, limit: int = 0) -> Stream:
        """Open a stream. ``limit``: the most bytes that it may allocate, 0 for no limit."""
        return Stream(self, data, limit)


class Stream:
    """A stream that is decoded frame by frame; of one thread."""

    def __init__(self, library: Library, data: bytes, limit: int) -> None:
        self._calls, self._data = library.calls, data
        self._stream = self._calls.gss_open(data, len(data), limit)
        if not self._stream:
            raise MemoryError("there is no memory for a decoder")

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._calls.gss_close(self._stream)

    def next(self) -> bool:
        """Decode the next frame; False at the end, and where :attr:`fault` says what came before it."""
        return bool(self._calls.gss_next(self._stream) == FRAME)

    @property
    def frame(self) -> int:
        """Index of the frame last decoded."""
        return int(self._calls.gss_state(self._stream)[0].frame)

    @property
    def rows(self) -> int:
        """Gaussians of the frame last decoded."""
        return int(self._calls.gss_state(self._stream)[0].rows)

    def hash(self) -> str:
        """Return the hash of the frame last decoded (section 0.5 of docs/spec)."""
        digits = ctypes.create_string_buffer(65)
        self._calls.gss_hash(self._calls.gss_state(self._stream), digits)
        return digits.value.decode()

    @property
    def fault(self) -> Fault | None:
        """What ended the stream before its end; None where nothing did."""
        said = self._calls.gss_error(self._stream)[0]
        return Fault(said.rule.decode(), said.byte, said.message.decode()) if said.code else None


def play(library: Library, data: bytes, limit: int = 0) -> tuple[list[str], Fault | None]:
    """Return the hashes of all frames of a stream, and what ended it before its end."""
    digests = []
    with library.open(data, limit) as stream:
        while stream.next():
            digests.append(stream.hash())
        return digests, stream.fault
