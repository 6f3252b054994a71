"""The front door for renderers: what they return, what they are given, and the loss and the optimiser they may bring.

A renderer that only draws needs ``Renderer`` and ``RenderOutput``; one that compiles a whole iteration needs the rest.
Records that all parts share (``Gaussians``, ``Cameras``) come from ``gsstream.api``.
"""

from gsstream.core.context import RowGradient as RowGradient
from gsstream.core.context import ScreenGradient as ScreenGradient
from gsstream.core.median import median as median
from gsstream.core.picture_size import COMPACT_PIXELS as COMPACT_PIXELS
from gsstream.parts.backend.base import Renderer as Renderer
from gsstream.parts.backend.base import ScatterSession as ScatterSession
from gsstream.parts.backend.change import Change as Change
from gsstream.parts.backend.change import ChangeRule as ChangeRule
from gsstream.parts.backend.change import changed_tiles as changed_tiles
from gsstream.parts.backend.row_optimiser import RowOptimiser as RowOptimiser
from gsstream.parts.render.drawn import drawn_rows as drawn_rows
from gsstream.parts.render.exposure import CameraExposure as CameraExposure
from gsstream.parts.render.images import check_tiles as check_tiles
from gsstream.parts.render.loss import Loss as Loss
from gsstream.parts.render.session import RenderCache as RenderCache
from gsstream.parts.render.session import RenderOutput as RenderOutput
from gsstream.parts.render.session import RenderSession as RenderSession
from gsstream.parts.render.target import ViewTarget as ViewTarget
from gsstream.parts.render.wrt import G as G
from gsstream.parts.render.wrt import LossAndGrad as LossAndGrad
from gsstream.parts.render.wrt import Wrt as Wrt
from gsstream.parts.render.wrt import WrtScene as WrtScene
from gsstream.parts.residual.adam_state import ADAM_BETAS as ADAM_BETAS
from gsstream.parts.residual.adam_state import ADAM_EPS as ADAM_EPS
from gsstream.parts.residual.adam_state import AdamState as AdamState
from gsstream.parts.residual.layout import JointLayout as JointLayout
from gsstream.parts.residual.optimiser import ResidualEpoch as ResidualEpoch
from gsstream.parts.residual.optimiser import ResidualOptimiser as ResidualOptimiser
