"""Stores on this machine: moto's S3 and a plain web server, both on loopback."""

from __future__ import annotations

import contextlib
import functools
import http.server
import logging
import os
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest

#: What s3fs reads; no test asks the network for more.
ACCOUNT = {
    "AWS_ACCESS_KEY_ID": "name-of-the-test",
    "AWS_SECRET_ACCESS_KEY": "secret-of-the-test",
    "AWS_DEFAULT_REGION": "us-east-1",
    "AWS_EC2_METADATA_DISABLED": "true",
}


class Bucket:
    """A bucket of moto's S3, and the environment in which s3fs finds it."""

    def __init__(self, name: str) -> None:
        server = pytest.importorskip("moto.server", reason="no S3 without moto[s3], flask and flask-cors")
        pytest.importorskip("s3fs", reason="no S3 without s3fs")
        logging.getLogger("werkzeug").setLevel(logging.ERROR)
        #: What a test opens besides; closed with the bucket.
        self.beside = contextlib.ExitStack()
        self._threaded = server.ThreadedMotoServer
        self.name, self.port = name, 0
        self.start()
        import boto3

        self.client: Any = boto3.client("s3", endpoint_url=self.endpoint, **_account())
        with contextlib.suppress(self.client.exceptions.BucketAlreadyOwnedByYou):
            self.client.create_bucket(Bucket=name)

    @property
    def endpoint(self) -> str:
        return f"http://127.0.0.1:{self.port}"

    @property
    def address(self) -> str:
        return f"s3://{self.name}"

    @property
    def environment(self) -> dict[str, str]:
        return {**ACCOUNT, "AWS_ENDPOINT_URL": self.endpoint}

    def start(self) -> None:
        """Answer, at the same place as before, with what was there before."""
        self._server = self._threaded(ip_address="127.0.0.1", port=self.port, verbose=False)
        self._server.start()
        self.port = self._server.get_host_and_port()[1]

    def stop(self) -> None:
        self._server.stop()

    def put(self, name: str, data: bytes) -> None:
        self.client.put_object(Bucket=self.name, Key=name, Body=data)

    def upload(self, folder: Path, name: str) -> None:
        for path in sorted(folder.rglob("*")):
            if path.is_file():
                self.put(f"{name}/{path.relative_to(folder).as_posix()}", path.read_bytes())

    def files(self, below: str = "") -> dict[str, bytes]:
        listed = self.client.list_objects_v2(Bucket=self.name, Prefix=below).get("Contents", [])
        return {o["Key"]: self.client.get_object(Bucket=self.name, Key=o["Key"])["Body"].read() for o in listed}


def _account() -> dict[str, str]:
    return {
        "aws_access_key_id": ACCOUNT["AWS_ACCESS_KEY_ID"],
        "aws_secret_access_key": ACCOUNT["AWS_SECRET_ACCESS_KEY"],
        "region_name": ACCOUNT["AWS_DEFAULT_REGION"],
    }


@contextmanager
def bucket(name: str, cache: Path) -> Iterator[Bucket]:
    """A bucket of its own, and an empty cache, while this is open."""
    made = Bucket(name)
    before = dict(os.environ)
    os.environ.update(made.environment, GSSTREAM_CACHE=str(cache))
    try:
        yield made
    finally:
        os.environ.clear()
        os.environ.update(before)
        made.beside.close()
        made.stop()


@contextmanager
def web_server(folder: Path) -> Iterator[tuple[str, list[str]]]:
    """Serve a folder as Python's own server does; gives its address and the list of what was asked for."""
    asked: list[str] = []

    class Quiet(http.server.SimpleHTTPRequestHandler):
        def log_message(self, *_: Any) -> None:
            asked.append(f"{self.command} {self.path}")

    with serving(functools.partial(Quiet, directory=str(folder))) as address:
        yield address, asked


@contextmanager
def refusing_store() -> Iterator[str]:
    """Answer every request as S3 does to an account without rights."""

    class Refusing(http.server.BaseHTTPRequestHandler):
        def do_GET(self) -> None:
            said = (
                f"<Error><Code>AccessDenied</Code><Message>{self.headers['Authorization']}</Message></Error>".encode()
            )
            self.send_response(403)
            self.send_header("Content-Type", "application/xml")
            self.send_header("Content-Length", str(len(said)))
            self.end_headers()
            self.wfile.write(said)

        do_HEAD = do_GET

        def log_message(self, *_: Any) -> None:
            pass

    with serving(Refusing) as address:
        yield address


@contextmanager
def serving(handler: Any) -> Iterator[str]:
    """A web server of this process, whose requests a handler answers; gives its address."""

    class Server(http.server.ThreadingHTTPServer):
        request_queue_size, daemon_threads = 256, True

    server = Server(("127.0.0.1", 0), handler)
    thread = threading.Thread(target=server.serve_forever, daemon=True)
    thread.start()
    try:
        yield f"http://127.0.0.1:{server.server_address[1]}"
    finally:
        server.shutdown()
        server.server_close()
        thread.join()
