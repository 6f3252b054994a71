"""What an update rule promises: encoder and player read its codes the same way."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import torch

from gsstream.core.changes import Layout, Residual, apply_residual, sent_rows
from gsstream.core.gaussians import ATTRIBUTES
from gsstream.packet import quantise_decoders
from gsstream.packet.base import MAX_CHANNELS
from gsstream.parts.residual.decode import add_joint, decode_joint, join_features
from gsstream.parts.residual.layout import joint_layout
from gsstream.parts.update.base import UpdateRule, init_latents, quantise_latents
from gsstream.testing.cases import fingerprint, get_case
from gsstream.testing.compare import equal
from gsstream.testing.registry import check

LEVELS = 4


def _decoders(part: UpdateRule, seed: int = 3) -> dict[str, torch.Tensor]:
    return part.init_decoders(get_case("cloud").gaussians, torch.Generator().manual_seed(seed))


@check("update")
def check_update_codes(part: UpdateRule) -> None:
    """Codes are of attributes that there are, with positive steps, rates that are not negative, and few channels."""
    codes = part.codes()
    unknown = sorted(set(codes) - set(ATTRIBUTES))
    assert not unknown, f"codes of {', '.join(unknown)}; Gaussians have {', '.join(ATTRIBUTES)}"
    for name, code in codes.items():
        assert np.isfinite(code.step) and code.step > 0, f"{name}: step: expected > 0, got {code.step}"
        rates = {"lr": code.lr, "decoder_lr": code.decoder_lr, "decoder_std": code.decoder_std}
        wrong = {key: value for key, value in rates.items() if not (np.isfinite(value) and value >= 0)}
        assert not wrong, f"{name}: expected finite and not negative, got {wrong}"
        assert 0 <= code.latent <= MAX_CHANNELS, f"{name}: latent: expected 0 to {MAX_CHANNELS}, got {code.latent}"
    assert codes == part.codes(), "codes() gives other codes the second time"


@check("update")
def check_update_decoders(part: UpdateRule) -> None:
    """Decoders are [L, D] float32 of the attributes that have latents, drawn from the generator alone."""
    case, codes = get_case("cloud"), part.codes()
    decoders = _decoders(part)
    for name, code in codes.items():
        width = int(getattr(case.gaussians, name)[0].numel())
        wanted = (code.latent, width) if code.latent and width else None
        got = tuple(decoders[name].shape) if name in decoders else None
        assert got == wanted, f"decoder of {name}: expected {wanted}, got {got}"
    extra = sorted(set(decoders) - set(codes))
    assert not extra, f"decoders of {', '.join(extra)}, which never change"
    for name, value in _decoders(part).items():
        equal(f"decoder of {name}, drawn again from the same seed", value, decoders[name])
    if any(codes[name].decoder_std > 0 for name in decoders):
        other = _decoders(part, 4)
        assert any(not torch.equal(value, other[name]) for name, value in decoders.items()), "the seed has no effect"


@check("update")
def check_update_closed_loop(part: UpdateRule) -> None:
    """Training renders the rows that a player computes from the integers, to the last bits of float32."""
    case = get_case("cloud")
    before = fingerprint(case.gaussians)
    n = len(case.gaussians)
    layout = Layout(np.ones(n, np.int32), np.zeros(n, np.uint8), np.array([0.25], np.float32))
    g = torch.Generator().manual_seed(5)
    level = torch.randint(0, LEVELS + 1, (n,), generator=g)
    decoders = _decoders(part)
    sent = quantise_decoders({name: value.numpy() for name, value in decoders.items()})
    decoders = {name: torch.from_numpy(value) for name, value in sent.items()}
    codes = part.codes()
    latents = {
        name: codes[name].step * 3 * torch.randn(value.shape, generator=g)
        for name, value in init_latents(part.codes(), case.gaussians).items()
    }
    code = joint_layout(codes, latents, decoders, case.gaussians)
    table = torch.cat(list(latents.values()), 1) if latents else torch.zeros(n, 0)
    change = decode_joint(code, table, code.join_decoders(decoders), torch.full((n,), 0.25))
    features = join_features(code, case.gaussians)
    trained = add_joint(code, case.gaussians, features, change=change, gates=level / LEVELS)
    rows = sent_rows(layout, level.numpy())
    integers: Mapping[str, torch.Tensor] = quantise_latents(codes, latents)
    residual = Residual(
        gates=level.numpy().astype(np.uint8),
        num_levels=LEVELS,
        symbols={name: value.numpy()[rows] for name, value in integers.items()},
        steps={name: codes[name].step for name in integers},
        decoders=sent,
    )
    played = apply_residual(case.gaussians.map(lambda t: t.numpy()), layout, residual)
    assert fingerprint(case.gaussians) == before, "the scene before was changed in place"
    for name, value in played.items():
        want = torch.from_numpy(np.asarray(value))
        equal(f"{name}", getattr(trained, name), want, tolerance=1e-5, why="float32, products in another order")
