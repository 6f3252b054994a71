"""Energy counters on a made-up sysfs: what is added, what is not, what is said when a file may not be read."""

from __future__ import annotations

import sys
import time
from pathlib import Path

import pytest
from gsstream_lab.energy import EnergyMeter, total_joules


def rapl(sysfs: Path, name: str, label: str, value: int, largest: int = 1_000_000) -> Path:
    folder = sysfs / "class" / "powercap" / name
    folder.mkdir(parents=True)
    (folder / "name").write_text(label + "\n")
    (folder / "max_energy_range_uj").write_text(f"{largest}\n")
    (folder / "energy_uj").write_text(f"{value}\n")
    return folder / "energy_uj"


def ina(sysfs: Path, device: str, rails: dict[int, tuple[str, int, int]]) -> Path:
    folder = sysfs / "bus" / "i2c" / "drivers" / "ina3221" / device / "hwmon" / "hwmon3"
    folder.mkdir(parents=True)
    for number, (label, millivolts, milliamperes) in rails.items():
        (folder / f"in{number}_label").write_text(label + "\n")
        (folder / f"in{number}_input").write_text(f"{millivolts}\n")
        (folder / f"curr{number}_input").write_text(f"{milliamperes}\n")
    return folder


def test_packages_and_memory_are_read_and_their_parts_are_not(tmp_path):
    first = rapl(tmp_path, "intel-rapl:0", "package-0", 100)
    second = rapl(tmp_path, "intel-rapl:1", "package-1", 0)
    cores = rapl(tmp_path, "intel-rapl:0:0", "core", 7)
    memory = rapl(tmp_path, "intel-rapl:0:1", "dram", 50)
    platform = rapl(tmp_path, "intel-rapl:2", "psys", 1)
    with EnergyMeter(tmp_path, nvml=False) as meter:
        for path, value in ((first, 500_100), (second, 20_000), (cores, 9_999), (memory, 80_050), (platform, 900_000)):
            path.write_text(str(value))
        rails = meter.read()
    assert rails == {"rapl:0 package-0": 0.5, "rapl:1 package-1": 0.02, "rapl:0:1 dram": 0.08}
    assert total_joules(rails) == pytest.approx(0.6)


def test_a_counter_that_starts_again_loses_nothing(tmp_path):
    path = rapl(tmp_path, "intel-rapl:0", "package-0", 900_000)
    meter = EnergyMeter(tmp_path, nvml=False)
    for value, joules in ((100_000, 0.2), (900_000, 1.0), (0, 1.1), (1_000_000, 2.1)):
        path.write_text(str(value))
        assert meter.read()["rapl:0 package-0"] == pytest.approx(joules)


def test_a_jetson_is_power_over_time_and_its_whole_is_not_added_to_its_parts(tmp_path):
    folder = ina(tmp_path, "1-0040", {1: ("VDD_IN", 5000, 2000), 2: ("VDD_CPU_GPU_CV", 5000, 1000), 3: ("", 1, 1)})
    (folder / "in3_label").unlink()
    started = time.monotonic()
    with EnergyMeter(tmp_path, nvml=False) as meter:
        time.sleep(0.15)
        rails = meter.read()
        elapsed = time.monotonic() - started
        later = meter.read()
    assert set(rails) == {"ina3221-1-0040:VDD_IN", "ina3221-1-0040:VDD_CPU_GPU_CV"}
    assert 1.4 < rails["ina3221-1-0040:VDD_IN"] <= 10 * elapsed
    assert rails["ina3221-1-0040:VDD_IN"] == pytest.approx(2 * rails["ina3221-1-0040:VDD_CPU_GPU_CV"])
    assert later["ina3221-1-0040:VDD_IN"] >= rails["ina3221-1-0040:VDD_IN"]
    assert total_joules(rails) == rails["ina3221-1-0040:VDD_IN"]
    assert total_joules({"ina3221-a:X": 1.0, "ina3221-a:Y": 2.0}) == 3.0


def test_a_sensor_that_goes_away_is_an_error_not_zero(tmp_path):
    folder = ina(tmp_path, "1-0040", {1: ("VDD_IN", 5000, 2000)})
    with EnergyMeter(tmp_path, nvml=False) as meter:
        (folder / "curr1_input").unlink()
        with pytest.raises(OSError, match="curr1_input"):
            meter.read()


def test_without_counters_nothing_is_measured_and_nothing_guessed(tmp_path):
    assert EnergyMeter(tmp_path, nvml=False).read() == {}
    assert total_joules({}) == 0
    path = rapl(tmp_path, "intel-rapl:0", "package-0", 1)
    path.write_text("not a number")
    meter = EnergyMeter(tmp_path, nvml=False)
    assert meter.counters == []
    assert meter.reasons[0].startswith("RAPL: ")


class FakeNvml:
    """The five functions of pynvml that are used: two GPUs, one of which works."""

    class NVMLError(Exception):
        pass

    def __init__(self, broken: bool = False) -> None:
        self.now, self.broken, self.open = [5000, 100], broken, False

    def nvmlInit(self) -> None:
        self.open = True

    def nvmlShutdown(self) -> None:
        self.open = False

    def nvmlDeviceGetCount(self) -> int:
        return 2

    def nvmlDeviceGetHandleByIndex(self, index: int) -> int:
        return index

    def nvmlDeviceGetTotalEnergyConsumption(self, handle: int) -> int:
        if self.broken:
            raise self.NVMLError("Not Supported")
        return self.now[handle]


def test_gpus_count_millijoules(tmp_path, monkeypatch):
    fake = FakeNvml()
    monkeypatch.setitem(sys.modules, "pynvml", fake)
    with EnergyMeter(tmp_path) as meter:
        fake.now = [7500, 100]
        assert meter.read() == {"gpu:0": 2.5, "gpu:1": 0.0}
    assert not fake.open
    monkeypatch.setitem(sys.modules, "pynvml", FakeNvml(broken=True))
    meter = EnergyMeter(tmp_path)
    assert (meter.counters, meter.reasons) == ([], ["NVML: Not Supported"])
