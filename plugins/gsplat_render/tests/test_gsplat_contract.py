"""The renderer keeps its contract, where there is a GPU with gsplat's kernels; elsewhere skipped with the reason."""

from __future__ import annotations

import pytest
from gsstream_gsplat_render.kernels import load_kernels
from gsstream_gsplat_render.renderer import GsplatRenderer

from gsstream.api import PluginUnavailable
from gsstream.testing import parametrize_with_checks

try:
    load_kernels("cuda")
except PluginUnavailable as error:

    @pytest.mark.skip(reason=f"needs an NVIDIA GPU with gsplat's kernels: {error}")
    def test_contract() -> None: ...

else:

    @parametrize_with_checks([GsplatRenderer()])
    def test_contract(check) -> None:
        check()
