"""A pretend accelerator: tensors that say they are on another device and whose memory is the processor's.

Arithmetic is the processor's, to the bit. What a GPU would refuse is refused: tensors of two devices in one operation,
a generator of the processor for a tensor of the device, numpy on one. What would make a GPU wait or copy is counted,
with the line that did it. So whether a loop stays on its device can be tested where there is none.

``torch.utils.backend_registration._setup_privateuseone_for_python_backend`` is marked experimental in torch; this file
is its only user. A process registers the device once, when it imports this file; tensors of the processor are not
affected. A process has one kind of accelerator for torch, and gradients on any other end in an error inside it: so
where torch sees a GPU, this device is refused.
"""

from __future__ import annotations

import math
import sys
from collections import Counter
from collections.abc import Callable
from typing import Any

import torch
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_leaves, tree_map
from torch.utils.backend_registration import _DummyBackendModule, _setup_privateuseone_for_python_backend

from gsstream.replay import Recorder

NAME = "pretend"
aten = torch.ops.aten
#: Operations whose result has a size that depends on values: a GPU has to be waited for.
SIZED_BY_VALUES = {
    aten.nonzero.default,
    aten.masked_select.default,
    aten._unique2.default,
    aten.unique_consecutive.default,
    aten.unique_dim.default,
    aten.repeat_interleave.Tensor,
    aten.bincount.default,
}

ALLOCATIONS = {aten.empty.memory_format, aten.empty_like.default, aten.empty_strided.default}


class _Module(_DummyBackendModule):
    def get_amp_supported_dtype(self) -> list[torch.dtype]:
        return [torch.float16]


#: The key of torch that the name belongs to, once it is registered.
DEVICE = torch.device("privateuseone", 0)


#: Torch counts its devices at the first backward pass, so the name is given when this file is imported.
AVAILABLE = not torch.cuda.is_available()
if AVAILABLE:
    _setup_privateuseone_for_python_backend(NAME, _Module())


def require_pretend() -> None:
    """Raise PretendUnavailable where torch sees a GPU."""
    if not AVAILABLE:
        raise PretendUnavailable(
            "the pretend device: expected a process in which torch sees no GPU, because it knows one kind of device at "
            "a time; set CUDA_VISIBLE_DEVICES= (empty) for this process"
        )


class PretendUnavailable(RuntimeError):
    """There is a GPU, whose gradients the pretend device would break."""


class DeviceMismatch(RuntimeError):
    """One operation was given tensors of two devices."""


class PretendTensor(torch.Tensor):
    """A tensor on the pretend device; ``memory`` is the tensor of the processor that holds its values."""

    memory: torch.Tensor

    @staticmethod
    def __new__(cls, memory: torch.Tensor) -> PretendTensor:
        out: PretendTensor = torch.Tensor._make_wrapper_subclass(
            cls,
            memory.size(),
            strides=memory.stride(),
            storage_offset=memory.storage_offset(),
            dtype=memory.dtype,
            layout=memory.layout,
            device=DEVICE,
        )
        out.memory = memory
        return out

    def __repr__(self, **_: Any) -> str:  # type: ignore[override]
        return f"PretendTensor({self.memory!r})"

    @classmethod
    def __torch_dispatch__(  # type: ignore[override]
        cls, func: Any, types: Any, args: Any = (), kwargs: Any = None
    ) -> Any:
        return _run(func, args, kwargs or {})


class PretendDevice(TorchDispatchMode):  # type: ignore[no-untyped-call]
    """While it is entered, ``device="pretend"`` works, and what crosses is counted by the line that did it.

    Attributes:
        up, down: copies to the device and from it.
        waits: values that the processor read, and results whose size depends on values.
        launches: operations that ran on the device; views and allocations are none.
    """

    def __init__(self) -> None:
        require_pretend()
        super().__init__()  # type: ignore[no-untyped-call]
        self.up, self.down, self.waits = Counter[str](), Counter[str](), Counter[str]()
        self.launches = 0

    @property
    def crossings(self) -> tuple[int, int, int]:
        """Copies up, copies down and waits so far."""
        return self.up.total(), self.down.total(), self.waits.total()

    def __enter__(self) -> PretendDevice:
        _ENTERED.append(self)
        super().__enter__()  # type: ignore[no-untyped-call]
        return self

    def __exit__(self, *error: Any) -> None:
        _ENTERED.pop()
        super().__exit__(*error)  # type: ignore[no-untyped-call]

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        return _run(func, args, kwargs or {})


_ENTERED: list[PretendDevice] = []
#: What is recorded at present, to be done again: see PretendRecorder.
_TAPE: list[Callable[[], None]] | None = None
_MADE: list[torch.Tensor] = []


class PretendRecorder(Recorder):
    """Records as a CUDA graph does: tensors stay, numbers are those of the recording, and waits are refused.

    What was computed while recording is overwritten, because a graph computes nothing before it is replayed.
    """

    #: Of the last record, kernels included; views and allocations count as none.
    operations = 0

    def record(self, work: Callable[[], None], *, is_new: bool) -> Callable[[], None]:
        global _TAPE
        if is_new:
            work()
        _TAPE, tape = [], list[Callable[[], None]]()
        _MADE.clear()
        try:
            work()
            tape = _TAPE
        finally:
            _TAPE = None
        self.operations = len(tape)
        for made in _MADE:
            made.fill_(math.nan if made.is_floating_point() else 1)

        def replay() -> None:
            for step in tape:
                step()
            if _ENTERED:
                _ENTERED[-1].launches += 1

        return replay


def _recorded(func: Any, values: Any, named: Any, result: Any) -> None:
    """Put one operation on the tape; a view needs nothing, because the memory that it looks at stays."""
    if _TAPE is None or func.is_view:
        return
    places = [x for x in tree_leaves(result) if isinstance(x, torch.Tensor)]
    given = {id(x) for x in tree_leaves((values, named)) if isinstance(x, torch.Tensor)}
    _MADE.extend(x for x in places if id(x) not in given)
    if func in ALLOCATIONS:
        return

    def again() -> None:
        for place, value in zip(
            places, (x for x in tree_leaves(func(*values, **named)) if isinstance(x, torch.Tensor)), strict=True
        ):
            if value is not place:
                place.copy_(value)

    _TAPE.append(again)


def _run(func: Any, args: Any, kwargs: dict[str, Any]) -> Any:
    tensors = [x for x in tree_leaves((args, kwargs)) if isinstance(x, torch.Tensor)]
    there = [x for x in tensors if isinstance(x, PretendTensor)]
    target = None if kwargs.get("device") is None else torch.device(kwargs["device"]).type
    if not there and target != NAME:
        return func(*args, **kwargs)
    if _ENTERED and _TAPE is None and not (func.is_view or func in ALLOCATIONS):
        _ENTERED[-1].launches += 1
    plain = {**kwargs, "device": torch.device("cpu")} if target is not None else kwargs
    values, named = tree_map(_memory, (args, plain))
    if func is aten._to_copy.default and target is not None:
        result = func(*values, **named)
        if (target == NAME) != bool(there):
            _count("up" if target == NAME else "down")
        _recorded(func, values, named, result)
        return PretendTensor(result) if target == NAME else result
    # A number of the processor may go along, as with CUDA.
    here = [x for x in tensors if not isinstance(x, PretendTensor) and x.dim() > 0]
    if func is aten.copy_.default and there and len(there) < len(tensors):
        _count("down" if isinstance(args[1], PretendTensor) else "up")
        values[0].copy_(values[1])
        return args[0]
    if func is aten._local_scalar_dense.default:
        _count("waits")
        return func(*values)
    _refuse(func, here, kwargs.get("generator"))
    if func in SIZED_BY_VALUES or (func is aten.index.Tensor and _has_mask(args[1])):
        _count("waits")
    result = func(*values, **named)
    _recorded(func, values, named, result)
    known = {id(x.memory): x for x in there}  # what works in place returns the very tensor it was given
    return tree_map(lambda x: known[id(x)] if id(x) in known else _tensor(x), result)


def _refuse(func: Any, here: list[torch.Tensor], generator: torch.Generator | None) -> None:
    if here:
        found = [f"{x.device.type} {list(x.shape)}" for x in here]
        raise DeviceMismatch(f"{func}: expected tensors of one device, got {', '.join(found)} beside {NAME}")
    if generator is not None and generator.device.type != NAME:
        raise DeviceMismatch(f"{func}: a generator of the {generator.device.type} for a tensor of the {NAME} device")


def _has_mask(indices: Any) -> bool:
    return any(isinstance(index, torch.Tensor) and index.dtype == torch.bool for index in indices)


def _memory(x: Any) -> Any:
    return x.memory if isinstance(x, PretendTensor) else x


def _tensor(x: Any) -> Any:
    return PretendTensor(x) if isinstance(x, torch.Tensor) and not isinstance(x, PretendTensor) else x


def _count(what: str) -> None:
    if _TAPE is not None:
        raise RuntimeError(f"a graph cannot be recorded: {what} is not allowed meanwhile")
    if not _ENTERED:
        return
    frame = sys._getframe(1)
    while frame.f_back and ("/torch/" in frame.f_code.co_filename or frame.f_code.co_filename == __file__):
        frame = frame.f_back
    parts = frame.f_code.co_filename.split("/")
    # Within the package, else the last folder: a line is found by it, whatever machine it is on.
    place = "/".join(parts[parts.index("gsstream") + 1 :] if "gsstream" in parts else parts[-2:])
    getattr(_ENTERED[-1], what)[f"{place}:{frame.f_lineno}"] += 1


# torch.tensor(..., device=) and new_tensor copy below every mode; these two are the operations that they call.
@torch.library.impl("aten::empty_strided", "privateuseone")
def _empty_strided(size: Any, stride: Any, *, dtype: Any = None, **_: Any) -> torch.Tensor:
    return PretendTensor(torch.empty_strided(size, stride, dtype=dtype))


@torch.library.impl("aten::_copy_from", "privateuseone")
def _copy_from(source: torch.Tensor, target: torch.Tensor, *_: Any) -> torch.Tensor:
    _count("up" if isinstance(target, PretendTensor) else "down")
    _memory(target).copy_(_memory(source))
    return target


class _Kernel(torch.autograd.Function):
    """A function of tensors as one kernel of the device; its own steps are neither checked nor counted."""

    @staticmethod
    def forward(ctx: Any, function: Any, names: tuple[str, ...], *values: Any) -> Any:
        cut = len(values) - len(names)
        inner = []
        for value, wanted in zip(values, ctx.needs_input_grad[2:], strict=True):
            if isinstance(value, torch.Tensor) and not isinstance(value, PretendTensor):
                raise DeviceMismatch(f"{function.__name__}: expected tensors of the device, got one of the processor")
            inner.append(value.memory.detach().requires_grad_(wanted) if isinstance(value, PretendTensor) else value)
        with torch.enable_grad():
            out = function(*inner[:cut], **dict(zip(names, inner[cut:], strict=True)))
        ctx.inner, ctx.out = inner, out if isinstance(out, tuple) else (out,)
        found = tuple(PretendTensor(x.detach()) if isinstance(x, torch.Tensor) else x for x in ctx.out)
        # Not the tensors themselves: whoever holds a gradient, too, makes autograd copy it.
        places = [made.memory if isinstance(made, PretendTensor) else None for made in found]

        def again() -> None:
            with torch.enable_grad():
                out = function(*inner[:cut], **dict(zip(names, inner[cut:], strict=True)))
            ctx.out = out if isinstance(out, tuple) else (out,)
            for place, x in zip(places, ctx.out, strict=True):
                if place is not None:
                    place.copy_(x.detach())

        if _TAPE is not None:
            _TAPE.append(again)
        pairs = [(made, x) for made, x in zip(found, ctx.out, strict=True) if isinstance(made, PretendTensor)]
        ctx.mark_non_differentiable(*(made for made, x in pairs if not x.requires_grad))
        return found if isinstance(out, tuple) else found[0]

    @staticmethod
    def backward(ctx: Any, *upstream: Any) -> Any:
        leaves = [x for x in ctx.inner if isinstance(x, torch.Tensor) and x.requires_grad]

        def gradients() -> tuple[torch.Tensor | None, ...]:
            roots = [
                (x, grad.memory)
                for x, grad in zip(ctx.out, upstream, strict=True)
                if isinstance(x, torch.Tensor) and x.requires_grad and grad is not None
            ]
            outputs, grads = [x for x, _ in roots], [grad for _, grad in roots]
            return torch.autograd.grad(outputs, leaves, grads, retain_graph=True, allow_unused=True)

        first = gradients()

        def again() -> None:
            for made, x in zip(first, gradients(), strict=True):
                if made is not None and x is not None:
                    made.copy_(x)

        if _TAPE is not None:
            _TAPE.append(again)
            _MADE.extend(x for x in first if x is not None)
        found = iter(first)
        back = [next(found) if isinstance(x, torch.Tensor) and x.requires_grad else None for x in ctx.inner]
        return (None, None, *(None if grad is None else PretendTensor(grad) for grad in back))


def kernel(function: Callable[..., Any]) -> Callable[..., Any]:
    """Return a function of tensors of the processor as one kernel of the device, with its gradient.

    The function returns a tensor or a tuple. Its steps are not counted: a kernel is one launch.
    """

    def call(*args: Any, **kwargs: Any) -> Any:
        if _ENTERED and _TAPE is None:
            _ENTERED[-1].launches += 1
        return _Kernel.apply(function, tuple(kwargs), *args, *kwargs.values())  # type: ignore[no-untyped-call]

    return call
