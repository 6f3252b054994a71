"""Recordings as every worker finds them."""

from __future__ import annotations

from pathlib import Path


def recording_uri(uri: str, data: Path | None) -> str:
    """Return the recording as a worker opens it, wherever it works: a relative folder lies in ``data``, or here."""
    if "://" in uri:
        return uri
    scheme, colon, rest = uri.rpartition(":")
    folder = (data or Path()) / rest
    return f"{scheme}{colon}{folder.resolve()}" if uri != "demo" and rest and folder.is_dir() else uri
