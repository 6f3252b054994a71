"""Addresses of a store: which text is one, and none with a secret in it."""

from __future__ import annotations

from urllib.parse import urlsplit

from gsstream.core.errors import InputError
from gsstream.core.names import last_part

#: Scheme -> the package that speaks it, beside fsspec itself.
SCHEMES = {"s3": "s3fs", "gs": "gcsfs", "https": "aiohttp", "http": "aiohttp"}


def is_address(text: str) -> bool:
    """Return whether a text is the address of a store, and not a path or another source."""
    scheme, separator, _ = text.partition("://")
    return bool(separator) and scheme in SCHEMES


def checked_address(text: str) -> str:
    """Return an address without the slash at its end.

    Raises InputError for one without a bucket or server, and for one with a password, a key or a token: who sees the
    list of processes, a recipe or a log would have it. The message does not repeat it.
    """
    parts = urlsplit(text)
    shown = f"{parts.scheme}://.../{last_part(text)}"
    if "@" in parts.netloc or parts.query or parts.fragment:
        raise InputError(
            f"{shown}: an address holds no user, password or ?query, because lists of processes and logs would show "
            f"it: {how_to_sign(parts.scheme)}"
        )
    if not parts.netloc:
        what = "a bucket" if parts.scheme in ("s3", "gs") else "a server"
        raise InputError(f"{shown}: the address does not name {what}; expected e.g. {parts.scheme}://NAME/FOLDER")
    if ".." in parts.path.split("/"):
        raise InputError(f"{shown}: the address goes up by '..'; name the folder itself")
    return text.rstrip("/")


def how_to_sign(scheme: str) -> str:
    """Return the way in which a store learns who asks."""
    if scheme == "s3":
        return (
            "set AWS_PROFILE, or AWS_ACCESS_KEY_ID and AWS_SECRET_ACCESS_KEY; FSSPEC_S3_ANON=true reads public buckets"
        )
    if scheme == "gs":
        return "set GOOGLE_APPLICATION_CREDENTIALS; FSSPEC_GS_TOKEN=anon reads public buckets"
    return 'set FSSPEC_HTTPS={"headers": {"Authorization": "..."}} (FSSPEC_HTTP for http)'
