"""Binary straight-through gates keep the contract; the released clamp breaks one promise, which is said here."""

from __future__ import annotations

from gsstream_binary_ste.binary import BinarySteGate

from gsstream.testing import parametrize_with_checks

Config = BinarySteGate.Config


@parametrize_with_checks([BinarySteGate(), BinarySteGate(Config(noise="none")), BinarySteGate(Config(temperature=2.0))])
def test_contract(check) -> None:
    check()


@parametrize_with_checks(
    [BinarySteGate(Config(clamp_gradient=True))],
    expected_failures={"check_gate_gradient_flow": "the released clamp blocks every gradient of a 0/1 gate"},
)
def test_contract_with_the_released_clamp(check) -> None:
    check()
