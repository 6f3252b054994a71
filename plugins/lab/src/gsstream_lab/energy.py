"""Energy by counters of the machine: sysfs RAPL, sysfs INA3221 (Jetson), NVML. What has no counter is not measured."""

from __future__ import annotations

import threading
import time
from collections.abc import Mapping
from pathlib import Path
from types import TracebackType
from typing import Any, Protocol, Self

from gsstream.engine.run.encoder import EncodedFrame
from gsstream.engine.run.session import RunListener

#: A rail that holds all the others of its board (Jetson modules): not added to them.
WHOLE_MODULE = "VDD_IN"
_INA_PERIOD = 0.02


class Counter(Protocol):
    """Joules since some moment, by rail; only differences mean something."""

    def read(self) -> Mapping[str, float]: ...

    def close(self) -> None: ...


class EnergyMeter:
    """Every counter of this machine, as a context manager: of sysfs, and of NVIDIA's library if it is installed.

    ``counters`` empty means: energy is not measured here, and ``reasons`` says why for whatever looked like a counter.
    """

    def __init__(self, sysfs: Path = Path("/sys"), *, nvml: bool = True) -> None:
        self.reasons: list[str] = []
        found = [_rapl(sysfs, self.reasons), _ina3221(sysfs, self.reasons), _nvml(self.reasons) if nvml else None]
        self.counters: list[Counter] = [counter for counter in found if counter is not None]

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> None:
        for counter in self.counters:
            counter.close()

    def read(self) -> dict[str, float]:
        """Return the joules since this meter was made, by rail; empty without counters."""
        return {name: joules for counter in self.counters for name, joules in counter.read().items()}


def total_joules(rails: Mapping[str, float]) -> float:
    """Sum of rails, none counted twice: where a module has a rail for its whole, its parts are left out."""
    whole = {name for name in rails if name.endswith(WHOLE_MODULE)}
    boards = {name.partition(":")[0] for name in whole}
    return sum(joules for name, joules in rails.items() if name in whole or name.partition(":")[0] not in boards)


class Rapl:
    """Intel and AMD packages (powercap): a counter of microjoules that starts again at its largest value.

    Only whole packages are read; cores and graphics are parts of them, memory is a rail of its own where it is offered.
    """

    def __init__(self, domains: Mapping[str, Path]) -> None:
        self._files = {name: folder / "energy_uj" for name, folder in domains.items()}
        self._range = {name: int((folder / "max_energy_range_uj").read_text()) for name, folder in domains.items()}
        self._last = {name: int(path.read_text()) for name, path in self._files.items()}
        self._sum = dict.fromkeys(self._files, 0)

    def read(self) -> Mapping[str, float]:
        """Call it at least once per turn of the counter (a minute or more at full load)."""
        for name, path in self._files.items():
            now = int(path.read_text())
            step = now - self._last[name]
            self._sum[name] += step if step >= 0 else step + self._range[name]
            self._last[name] = now
        return {name: value / 1e6 for name, value in self._sum.items()}

    def close(self) -> None:
        """Do nothing: these counters hold no handle."""


def _rapl(sysfs: Path, reasons: list[str]) -> Rapl | None:
    domains: dict[str, Path] = {}
    # intel-rapl:0 is a package, intel-rapl:0:1 a part of it; AMD's packages carry the same names.
    for folder in sorted((sysfs / "class" / "powercap").glob("intel-rapl:*")):
        try:
            name = (folder / "name").read_text().strip()
        except OSError:
            continue  # not a domain
        # psys is the whole platform, packages included.
        if (folder.name.count(":") == 1 and name != "psys") or name == "dram":
            domains[f"rapl:{folder.name.removeprefix('intel-rapl:')} {name}"] = folder
    return _first_reading(lambda: Rapl(domains), "RAPL", reasons) if domains else None


class Ina3221:
    """Power monitors of a Jetson: voltage times current, sampled and added up by a thread."""

    def __init__(self, rails: Mapping[str, tuple[Path, Path]], period: float = _INA_PERIOD) -> None:
        self._rails, self._period = dict(rails), period
        self._sum = dict.fromkeys(rails, 0.0)
        self._lock, self._stop = threading.Lock(), threading.Event()
        self._at, self._watts = time.monotonic(), self._power()
        self._error: OSError | None = None
        self._thread = threading.Thread(target=self._work, daemon=True)
        self._thread.start()

    def _power(self) -> dict[str, float]:
        """Watts by rail: millivolts times milliamperes."""
        return {name: int(v.read_text()) * int(i.read_text()) / 1e6 for name, (v, i) in self._rails.items()}

    def _sample(self) -> None:
        with self._lock:
            now, watts = time.monotonic(), self._power()
            for name, value in watts.items():
                self._sum[name] += (now - self._at) * (value + self._watts[name]) / 2
            self._at, self._watts = now, watts

    def _work(self) -> None:
        while not self._stop.wait(self._period):
            try:
                self._sample()
            except OSError as error:
                self._error = error
                return

    def read(self) -> Mapping[str, float]:
        """Return joules by rail. Raises OSError when the sensor stopped answering: a gap would read as no power."""
        if self._error is not None:
            raise self._error
        self._sample()
        return dict(self._sum)

    def close(self) -> None:
        """End the thread."""
        self._stop.set()
        self._thread.join()


def _ina3221(sysfs: Path, reasons: list[str]) -> Ina3221 | None:
    rails = {}
    for folder in sorted((sysfs / "bus" / "i2c" / "drivers" / "ina3221").glob("*/hwmon/hwmon*")):
        for label in sorted(folder.glob("in[1-3]_label")):
            number, name = label.name[2], label.read_text().strip()
            files = (folder / f"in{number}_input", folder / f"curr{number}_input")
            if all(path.exists() for path in files):
                rails[f"ina3221-{folder.parent.parent.name}:{name}"] = files
    return _first_reading(lambda: Ina3221(rails), "INA3221", reasons) if rails else None


class Nvml:
    """NVIDIA GPUs that count their energy themselves (Volta and newer)."""

    def __init__(self, library: Any) -> None:
        self._library = library
        handles = [library.nvmlDeviceGetHandleByIndex(i) for i in range(library.nvmlDeviceGetCount())]
        self._handles = {f"gpu:{i}": handle for i, handle in enumerate(handles)}
        self._start = self._counters()

    def _counters(self) -> dict[str, float]:
        read = self._library.nvmlDeviceGetTotalEnergyConsumption
        return {name: read(handle) / 1000 for name, handle in self._handles.items()}

    def read(self) -> Mapping[str, float]:
        return {name: value - self._start[name] for name, value in self._counters().items()}

    def close(self) -> None:
        self._library.nvmlShutdown()


def _nvml(reasons: list[str]) -> Nvml | None:
    try:
        import pynvml
    except ImportError:
        return None
    try:
        pynvml.nvmlInit()
        return Nvml(pynvml)
    except pynvml.NVMLError as error:
        reasons.append(f"NVML: {error}")
        return None


def _first_reading(make: Any, name: str, reasons: list[str]) -> Any:
    """A counter that can be read now, else None with the reason: most often the files are the administrator's alone."""
    try:
        return make()
    except (OSError, ValueError) as error:
        reasons.append(f"{name}: {error}")
        return None


class FrameEnergy(RunListener):
    """Writes the joules of every frame's encoding into its line of metrics; without counters, nothing."""

    def __init__(self, meter: EnergyMeter) -> None:
        self._meter, self._before = meter, dict[str, float]()

    def before(self) -> None:
        self._before = self._meter.read()

    def after(self, step: EncodedFrame) -> Mapping[str, Any]:
        if not self._before:
            return {}
        return {"joules": {name: value - self._before[name] for name, value in self._meter.read().items()}}
