"""``disturbed:KEY=VALUE,...:URI``: a recording that is disturbed on purpose, for experiments and tests.

::

    gsstream run --source disturbed:noise_sigma=20,seed=1:demo ...
    gsstream run --source disturbed:lost_cameras=cam03@10-20+cam05@3-4,lost_as=black:FOLDER ...
    gsstream run --source disturbed:time_offset=cam03@2:FOLDER ...
    gsstream run --source disturbed:ways=11:FOLDER ...    # there and back again, five times

A stream names the whole URI as its recording, so that evaluating and resuming see the same disturbed images.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np

from gsstream.core.errors import SourceError
from gsstream.core.frame import Arrival, Frame
from gsstream.core.rng import Rng
from gsstream.core.shapes import FloatArray
from gsstream.core.storage import packed
from gsstream.discovery.catalog import load_catalog
from gsstream.engine.run.recording import open_plain
from gsstream.input.recordings.base import Moment, Source, SourceInfo, Split, Wrapped, assembled, check_index
from gsstream_lab.disturbances import (
    Disturbances,
    gain_at,
    is_lost,
    parse_disturbances,
    parse_drifts,
    parse_losses,
    parse_offsets,
    recorded_frame,
    with_gain,
    with_noise,
)


def open_disturbed(uri: str, scale: float = 1.0) -> Source:
    """Open ``disturbed:KEY=VALUE,...:URI``; URI may be that of any source, also of another one that is disturbed.

    Raises SourceError for an unknown key, and what opening URI raises.
    """
    text, colon, inner = uri.removeprefix("disturbed:").partition(":")
    if not colon:
        raise SourceError(f"source {uri[:200]!r}: expected disturbed:KEY=VALUE,...:URI, e.g. disturbed:gain=0.8:demo")
    options, seed = parse_disturbances(text)
    source = open_plain(inner, scale, load_catalog())
    try:
        return DisturbedSource(source, options, seed, uri)
    except SourceError:
        source.close()
        raise


class DisturbedSource(Wrapped):
    """A source over another one under disturbances. Thread-safe when the inner source is; equal seeds give equal bits.

    Frame t of the run is frame ``start + t + offset`` of the recording for each camera, where ``start`` makes room for
    negative offsets; the run is shorter by the span of the offsets, so that no frame of a camera is shown twice. With
    several ways, the recording is gone through forwards and backwards in turn. Order: ways, time offset, gain (all
    cameras), drift, noise, losses and the rounding of storage (training cameras).
    """

    def __init__(self, source: Source, disturbances: Disturbances, seed: int, uri: str) -> None:
        super().__init__(source)
        self._disturbances, self._rng, info = disturbances, Rng(seed), source.info
        ids = (*info.train.ids, *info.test.ids)
        self._offsets = parse_offsets(disturbances.time_offset, ids)
        self._drifts = parse_drifts(disturbances.drift, ids)
        self._losses = parse_losses(disturbances.lost_cameras, info.train.ids)
        used = [self._offsets.get(name, 0) for name in ids]
        self._start = max(0, -min(used))
        frames = info.num_frames
        if frames is not None:
            frames -= self._start + max(0, *used)
            if frames < 1:
                raise SourceError(
                    f"disturbed source: time_offset: offsets from {min(used)} to {max(used)} leave no common frame of "
                    f"the {info.num_frames} that {info.name!r} has; use smaller offsets"
                )
        if frames is None and disturbances.ways > 1:
            raise SourceError(
                f"disturbed source: ways: {info.name!r} is still being written: nobody knows where to turn"
            )
        self._once = frames
        whole = frames if frames is None else 1 + disturbances.ways * (frames - 1)
        self._info = replace(info, uri=uri, num_frames=whole)

    @property
    def info(self) -> SourceInfo:
        """The inner recording's, with the frames that are left, under the URI that brings the disturbances back."""
        return self._info

    def frame(self, index: int, split: Split = "train") -> Frame:
        """Read one instant. Raises SourceError as the inner source does."""
        return self.stored_frame(index, split).as_float32()

    def image(self, index: int, camera: str) -> FloatArray:
        """Return one camera's image under the disturbances."""
        check_index(self._info, index)
        options, training = self._disturbances, camera in self._info.train.ids
        shown = self._delivered_frame(camera, index) if training else index
        if shown is None:
            return np.zeros((self._info.train.height, self._info.train.width, 3), np.float32)
        image = self._source.image(self._place(shown) + self._offsets.get(camera, 0), camera)
        image = with_gain(image, gain_at(options, shown, self._rng))
        if camera in self._drifts:
            image = with_gain(image, 1 + self._drifts[camera] * np.float32(shown))
        if training and options.noise_sigma > 0 and shown < options.noise_frames:
            image = with_noise(image, options.noise_sigma, camera, index=shown, rng=self._rng)
        return image

    def stored_image(self, index: int, camera: str) -> Any:
        """Return one camera's image under the disturbances as it is stored."""
        return packed(self.image(index, camera))

    def stored_frame(self, index: int, split: Split = "train") -> Frame:
        """Read one instant as it is stored. Raises SourceError as the inner source does."""
        return assembled(self, index, split)

    @property
    def stores_bytes(self) -> bool:
        """Whether the inner source hands over bytes, which no gain and no noise takes off their levels."""
        options = self._disturbances
        same = options.gain == 1 and options.gain_amplitude == 0 and options.noise_sigma == 0 and not self._drifts
        return same and self._source.stores_bytes

    def moment(self, index: int) -> Moment:
        """Return what the inner source says of an instant, which is there with the last image that it is made of."""
        moments = {offset: self._source.moment(self._place(index) + offset) for offset in self._used_offsets}
        came = [moment.arrival for moment in moments.values() if moment.arrival is not None]
        complete = max((arrival.complete for arrival in came if arrival.complete is not None), default=None)
        missing = {name for arrival in came for name in arrival.absent}
        ids = (*self._info.train.ids, *self._info.test.ids)
        return Moment(
            moments[0].epoch_scale,
            Arrival(complete, tuple(name for name in self._info.train.ids if name in missing)) if came else None,
            tuple(name for name in ids if name in moments[self._offsets.get(name, 0)].held),
        )

    def epoch_scale(self, index: int) -> float:
        """Return what the inner source says that a frame is worth."""
        return self._source.epoch_scale(self._place(index))

    def waiting(self, index: int) -> int:
        """Return how many frames after the one that is shown the inner source has."""
        return self._source.waiting(self._place(index))

    def go_on_at(self, index: int, past: Mapping[int, Moment]) -> None:
        """Tell the inner source which of its frames are done."""
        shown = {self._place(done): past[done] for done in range(index) if done in past}
        self._source.go_on_at(max((self._place(done) + 1 for done in range(index)), default=0), shown)

    def _place(self, index: int) -> int:
        """The frame of the recording that a camera without an offset shows."""
        return self._start + recorded_frame(index, self._once)

    @property
    def _used_offsets(self) -> list[int]:
        return sorted({0, *self._offsets.values()})

    def _delivered_frame(self, name: str, index: int) -> int | None:
        """The frame whose image this camera delivers at ``index``; None: a black one."""
        while is_lost(self._disturbances, self._losses, name, index=index, rng=self._rng):
            if self._disturbances.lost_as == "black":
                return None
            index -= 1
        return index
