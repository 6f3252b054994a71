"""What several tests of the page share."""

from __future__ import annotations

import shutil

import pytest
from moving_scenes import moving_packets

from gsstream.packet import StreamWriter
from gsstream.serve.package import package


@pytest.fixture(scope="module")
def site(tmp_path_factory):
    """A packaged stream of 12 frames and two segments, and the stream itself beside the page."""
    folder = tmp_path_factory.mktemp("site")
    stream = folder.parent / f"{folder.name}.gss"
    with StreamWriter.open(stream) as writer:
        for packet in moving_packets(seed=3, frames=12, number=80, nodes=20, key_at=7):
            writer.append(packet)
    package(stream, folder)
    shutil.copy(stream, folder / "stream.gss")
    return folder
