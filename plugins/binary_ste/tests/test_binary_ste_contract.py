"""Binary straight-through gates keep the contract; the released clamp breaks a promise, which the part denies."""

from __future__ import annotations

from gsstream_binary_ste.binary import BinarySteGate

from gsstream.testing import parametrize_with_checks

Config = BinarySteGate.Config


@parametrize_with_checks(
    [
        BinarySteGate(), BinarySteGate(Config(noise="none")), BinarySteGate(Config(temperature=2.0)),
        BinarySteGate(Config(clamp_gradient=True)),
    ]
)  # fmt: skip
def test_contract(check) -> None:
    check()
