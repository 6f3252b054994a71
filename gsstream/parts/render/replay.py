"""Work on a GPU that is queued once and then replayed: a CUDA graph instead of hundreds of launches.

An iteration of a frame is the same few hundred operations each time, on tensors of the same sizes, and to queue them
takes the processor ten times as long as the GPU takes to do them. :class:`Records` records a function of tensors the
first time it is called, and replays it from then on: what differs is copied into tensors that stay where they are.

A function that is recorded reads no value, makes nothing whose size depends on values, and copies nothing from the
processor. What it takes from elsewhere than its arguments must stay where it is while the record is used.
"""

from __future__ import annotations

import gc
import sys
from abc import ABC, abstractmethod
from collections import OrderedDict
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import fields, is_dataclass
from functools import partial, reduce
from operator import and_
from typing import Any, Protocol, TypeVar, cast, final

import torch

from gsstream.core.deferred import Check, are_deferred, collected_checks, watch

T = TypeVar("T")
I = TypeVar("I")  # noqa: E741
Work = Callable[[], None]


class RecordError(RuntimeError):
    """A function cannot be recorded; the cause says why."""


class Recorder(ABC):
    """Records what is queued on a device.

    ``refused`` names what could not be recorded: it is not tried again. ``done`` holds what was recorded, whatever its
    sizes: libraries are loaded and tables made. ``is_busy``: something is being recorded, with all that it calls.
    """

    def __init__(self) -> None:
        self.refused: set[str] = set()
        self.done: set[object] = set()
        self.is_busy = False

    @abstractmethod
    def record(self, work: Work, *, is_new: bool) -> Work:
        """Record what ``work()`` queues, and return what does it.

        ``is_new``: nothing like it was recorded before, so it is done once beforehand, and loads what it needs.

        Raises whatever ``work`` or the device raises.
        """


@final
class CudaRecorder(Recorder):
    """CUDA graphs of one device, which share their memory: what one returned holds until another is replayed."""

    def __init__(self, device: torch.device) -> None:
        super().__init__()
        self._device = device
        self._begin_anew()

    def _begin_anew(self) -> None:
        self._stream = torch.cuda.Stream(self._device)  # type: ignore[no-untyped-call]
        self._pool = torch.cuda.graph_pool_handle()
        # Memory that no graph holds is given back for good, so one graph stays.
        one = torch.zeros(1, device=self._device)
        self._keeper = self._captured(lambda: setattr(self, "_kept", one + 1))

    def record(self, work: Work, *, is_new: bool) -> Work:
        try:
            return self._recorded(work, is_new=is_new)
        except Exception:
            if is_new:
                raise
            # A kernel that is loaded during a capture can end it: what was never done in these sizes is done once.
            self._begin_anew()
            return self._recorded(work, is_new=True)

    def _recorded(self, work: Work, *, is_new: bool) -> Work:
        before = torch.cuda.current_stream(self._device)
        self._stream.wait_stream(before)
        if is_new:
            with torch.cuda.stream(self._stream):
                work()
        graph = self._captured(work)
        before.wait_stream(self._stream)
        return graph.replay

    def _captured(self, work: Work) -> torch.cuda.CUDAGraph:
        graph, collects = torch.cuda.CUDAGraph(), gc.isenabled()
        # What Python finds to be garbage meanwhile may hold another graph, and to free one ends a capture.
        gc.disable()
        try:
            with torch.cuda.stream(self._stream):
                # By thread, because others read and decode meanwhile and may ask for memory.
                graph.capture_begin(pool=self._pool, capture_error_mode="thread_local")
                try:
                    work()
                except BaseException:
                    with suppress(RuntimeError):  # of a capture that failed, which the first error explains
                        graph.capture_end()
                    raise
                graph.capture_end()
        finally:
            if collects:
                gc.enable()
        return graph


class Room(Protocol):
    """What has a fixed size in a record, and may turn out to be too small.

    A replay for which it was too small left its view out; nothing it returned is wrong but for that.
    """

    def suffices(self) -> torch.Tensor:
        """Return [] bool: it was large enough for every replay since it last grew."""

    def grow(self) -> None:
        """Have records that are made from now on find enough of it."""


def recorder_on(device: torch.device) -> Recorder | None:
    """Return what records the work of a device; None: work of this kind of device is not recorded."""
    return CudaRecorder(device) if device.type == "cuda" else None


@final
class Records:
    """Records of functions, by the sizes of what they are called with.

    Arguments:
        recorder: of the device.
        keep: number of records that are kept; the one that was used longest ago makes room.
        room: of what has a fixed size in these records; None: nothing has.
        is_watched: have checks of numbers read with the deferred ones; else the caller asks :meth:`held`.
    """

    def __init__(self, recorder: Recorder, keep: int = 4, *, room: Room | None = None, is_watched: bool = True) -> None:
        self.recorder, self._keep, self._room, self._is_watched = recorder, keep, room, is_watched
        self._records: OrderedDict[Any, _Record] = OrderedDict()

    def can(self, name: str) -> bool:
        """Say whether a function may be recorded: nothing of its name was refused, and checks are read later."""
        return not self.recorder.is_busy and name not in self.recorder.refused and are_deferred()

    def call(self, name: str, function: Callable[[I], T], inputs: I, changed: Sequence[torch.Tensor] = ()) -> T:
        """Return what the function returns, in tensors that belong to the caller.

        Arguments:
            name: of the function; functions of one name do the same with the same inputs.
            function: what is recorded.
            inputs: tensors on the device, in dataclasses, tuples and mappings; everything else in them is part of the
                record: another number is another record.
            changed: tensors that the function changes in place.

        Raises RecordError where the function cannot be recorded; then ``changed`` is as it was, and the name refused.
        """
        leaves: list[torch.Tensor] = []
        form = _take(inputs, leaves)
        key = (name, form, tuple((value.shape, value.dtype) for value in leaves))
        record = self._records.pop(key, None)
        if record is None:
            while len(self._records) >= self._keep:
                self._records.popitem(last=False)
            record = self._record(name, cast(Callable[[Any], Any], function), form=form, leaves=leaves, changed=changed)
        self._records[key] = record
        record.replay(leaves)
        if self._is_watched:
            record.watch()
            if self._room is not None:
                watch(self, self._room.suffices, self._room.grow)
        return cast(T, record.copied())

    def _record(
        self,
        name: str,
        function: Callable[[Any], Any],
        form: Any,
        leaves: list[torch.Tensor],
        changed: Sequence[torch.Tensor],
    ) -> _Record:
        kind = name, tuple(value.dtype for value in leaves)
        kept = [value.clone() for value in changed]
        try:
            self.recorder.is_busy = True
            made = _Record(form, leaves)
            made.record(self.recorder, function, is_new=kind not in self.recorder.done)
        except Exception as error:
            self.recorder.refused.add(name)
            said = f"{type(error).__name__}: {error}".splitlines()[0]
            print(
                f"note: {name}: queued one operation at a time, because no CUDA graph holds it ({said})",
                file=sys.stderr,
            )
            raise RecordError(said) from error
        finally:
            self.recorder.is_busy = False
            if kept:
                torch._foreach_copy_(list(changed), kept)
        self.recorder.done.add(kind)
        return made

    def held(self) -> bool:
        """Say whether all checks of all replays held, and there was room; waits for the device. Else, make room."""
        flags = [record.held for record in self._records.values()]
        if self._room is not None:
            flags.append(self._room.suffices())
        if bool(reduce(and_, flags)):
            return True
        if self._room is not None and not bool(self._room.suffices()):
            self._room.grow()
        return False

    def beside(self) -> Records:
        """Return more records of the same device, whose checks the caller reads."""
        return Records(self.recorder, self._keep, room=self._room, is_watched=False)


@final
class _Record:
    """One function on tensors that stay, and what it returns."""

    def __init__(self, form: Any, leaves: list[torch.Tensor]) -> None:
        self._slots = [value.detach().clone() for value in leaves]
        self._inputs = _put(form, iter(self._slots))
        self._loaded = [(value, value._version) for value in leaves]
        self._form: Any = None
        self._made: list[torch.Tensor] = []
        self._checks: list[Check] = []
        self.held = torch.ones((), dtype=torch.bool, device=leaves[0].device)

    def record(self, recorder: Recorder, function: Callable[[Any], Any], *, is_new: bool) -> None:
        # The function is not kept: what it was made from may be long gone when its record is still used.
        self._replay = recorder.record(partial(self._work, function), is_new=is_new)
        self.held.fill_(True)  # of what was done once beforehand

    def _work(self, function: Callable[[Any], Any]) -> None:
        made: list[torch.Tensor] = []
        with collected_checks() as self._checks:
            self._form = _take(function(self._inputs), made)
        self._made = [value.detach() for value in made]
        if self._checks:
            self._passed = torch.stack([ok for ok, _ in self._checks])
            self.held.logical_and_(self._passed.all())

    def replay(self, leaves: list[torch.Tensor]) -> None:
        """Copy what differs from the last time, and do it."""
        by_type: dict[torch.dtype, tuple[list[torch.Tensor], list[torch.Tensor]]] = {}
        for place, (slot, value) in enumerate(zip(self._slots, leaves, strict=True)):
            last, version = self._loaded[place]
            if value is not last or value._version != version:
                to, source = by_type.setdefault(value.dtype, ([], []))
                to.append(slot)
                source.append(value.detach())
                self._loaded[place] = value, value._version
        for to, source in by_type.values():
            torch._foreach_copy_(to, source)
        self._replay()

    def copied(self) -> Any:
        """Return what the last replay made, in tensors of its own: the next replay writes over the record's."""
        return _put(self._form, iter([value.clone() for value in self._made]))

    def watch(self) -> None:
        if self._checks:
            watch(self, lambda: self.held, self._fail)

    def _fail(self) -> None:
        self.held.fill_(True)
        failed = [place for place, ok in enumerate(self._passed.cpu().tolist()) if not ok]
        raise self._checks[failed[0] if failed else 0][1]()


def tensors_of(value: object) -> list[torch.Tensor]:
    """Return the tensors in dataclasses, tuples and mappings."""
    found: list[torch.Tensor] = []
    _take(value, found)
    return found


def _take(value: Any, leaves: list[torch.Tensor]) -> Any:
    """What a value is made of, hashable, with its tensors taken out of it."""
    if isinstance(value, torch.Tensor):
        leaves.append(value)
        return _TENSOR
    if is_dataclass(value) and not isinstance(value, type):
        return type(value), tuple((field.name, _take(getattr(value, field.name), leaves)) for field in fields(value))
    if isinstance(value, tuple):
        return type(value), tuple(_take(each, leaves) for each in value)
    if isinstance(value, Mapping):
        return dict, tuple((name, _take(each, leaves)) for name, each in value.items())
    return _Plain, value


def _put(form: Any, leaves: Iterator[torch.Tensor]) -> Any:
    """The value of a form, with these tensors in it."""
    if form is _TENSOR:
        return next(leaves)
    kind, parts = form
    if kind is _Plain:
        return parts
    if kind is dict or is_dataclass(kind):
        return cast(Any, kind)(**{name: _put(part, leaves) for name, part in parts})
    made = [_put(part, leaves) for part in parts]
    return kind(*made) if hasattr(kind, "_fields") else kind(made)


class _Plain:
    """Marks what is neither a tensor nor made of any."""


_TENSOR = object()
