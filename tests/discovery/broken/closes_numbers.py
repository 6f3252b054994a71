"""Closes the files of both standard streams by their numbers."""

import os

from gsstream.spec import hookimpl


@hookimpl
def gsstream_components():
    os.close(1)
    os.close(2)
    return []
