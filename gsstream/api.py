"""The front door: every name a plugin or a script may import.

Importing this module imports torch (the parts are torch code); ``gsstream.spec`` does not.
"""

from gsstream import API_VERSION as API_VERSION
from gsstream.confidence.base import ConfidenceEstimator as ConfidenceEstimator
from gsstream.core.births import Births as Births
from gsstream.core.births import in_nodes as in_nodes
from gsstream.core.births import own_nodes as own_nodes
from gsstream.core.cameras import Cameras as Cameras
from gsstream.core.context import FrameContext as FrameContext
from gsstream.core.context import ScreenGradient as ScreenGradient
from gsstream.core.delta import Delta as Delta
from gsstream.core.delta import Layout as Layout
from gsstream.core.delta import apply_delta as apply_delta
from gsstream.core.delta import next_layout as next_layout
from gsstream.core.errors import ComponentError as ComponentError
from gsstream.core.errors import GsstreamError as GsstreamError
from gsstream.core.errors import InputError as InputError
from gsstream.core.errors import PacketError as PacketError
from gsstream.core.errors import PluginUnavailable as PluginUnavailable
from gsstream.core.errors import RecipeError as RecipeError
from gsstream.core.errors import ShapeError as ShapeError
from gsstream.core.errors import SourceError as SourceError
from gsstream.core.errors import UnknownName as UnknownName
from gsstream.core.frame import Frame as Frame
from gsstream.core.frame import PointCloud as PointCloud
from gsstream.core.gaussians import ATTRIBUTES as ATTRIBUTES
from gsstream.core.gaussians import Gaussians as Gaussians
from gsstream.core.hierarchy import Hierarchy as Hierarchy
from gsstream.core.hierarchy import tree_max as tree_max
from gsstream.core.hierarchy import tree_roots as tree_roots
from gsstream.core.part import Part as Part
from gsstream.core.part import PartConfig as PartConfig
from gsstream.core.part import Traits as Traits
from gsstream.core.rng import Rng as Rng
from gsstream.core.shapes import check_finite as check_finite
from gsstream.core.shapes import check_shape as check_shape
from gsstream.core.state import GateState as GateState
from gsstream.core.state import rows as rows
from gsstream.core.topology import TopologyEdit as TopologyEdit
from gsstream.gate.base import GateSampler as GateSampler
from gsstream.loss.base import Loss as Loss
from gsstream.propagation.base import Propagation as Propagation
from gsstream.regularizer.base import Regularizer as Regularizer
from gsstream.render.base import RenderCache as RenderCache
from gsstream.render.base import Renderer as Renderer
from gsstream.render.base import RenderOutput as RenderOutput
from gsstream.render.base import RenderSession as RenderSession
from gsstream.render.base import ScatterSession as ScatterSession
from gsstream.residual.base import AttributeCode as AttributeCode
from gsstream.residual.base import UpdateRule as UpdateRule
from gsstream.source.base import FrameSource as FrameSource
from gsstream.source.base import SourceInfo as SourceInfo
from gsstream.structure.base import Anchors as Anchors
from gsstream.structure.base import Structure as Structure
