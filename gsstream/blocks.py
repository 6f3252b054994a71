"""Functions that the engine itself is built from, for methods and parts that do more than fill a slot.

``gsstream.api`` has the nouns (records and contracts); these are the functions that such a method would otherwise
copy: densify, count changed tiles, learn residuals side by side, weigh their rate, compare a view, fit a packet.
"""

from gsstream.core.changes.motion import GroupTransforms as GroupTransforms
from gsstream.core.changes.motion import predict_transforms as predict_transforms
from gsstream.core.changes.rows import gather_rows as gather_rows
from gsstream.core.picture_size import bit_price_factor as bit_price_factor
from gsstream.core.picture_size import enlargement as enlargement
from gsstream.engine.fit.densify import SPLIT_SIZE as SPLIT_SIZE
from gsstream.engine.fit.densify import DensifyStatistics as DensifyStatistics
from gsstream.engine.fit.densify import split_or_clone as split_or_clone
from gsstream.engine.fit.nearest import k_nearest as k_nearest
from gsstream.engine.fit.nearest import nearest_rows as nearest_rows
from gsstream.engine.fit.nearest import neighbour_distance as neighbour_distance
from gsstream.parts.backend.change import count_per_tile as count_per_tile
from gsstream.parts.growth.copying import CopySettings as CopySettings
from gsstream.parts.growth.copying import least_opaque as least_opaque
from gsstream.parts.growth.copying import replace_with_copies as replace_with_copies
from gsstream.parts.growth.fitting import fit_added as fit_added
from gsstream.parts.motion.field import approximate_by_cells as approximate_by_cells
from gsstream.parts.motion.field import rounded_motion as rounded_motion
from gsstream.parts.motion.field import transform_rows as transform_rows
from gsstream.parts.motion.fitting import GroupAdam as GroupAdam
from gsstream.parts.motion.fitting import elementwise as elementwise
from gsstream.parts.motion.fitting import fit_transforms_adam as fit_transforms_adam
from gsstream.parts.motion.fitting import found_transforms as found_transforms
from gsstream.parts.motion.fitting import groupwise_max as groupwise_max
from gsstream.parts.motion.fitting import narrow_to as narrow_to
from gsstream.parts.motion.groups import groups_of_rows as groups_of_rows
from gsstream.parts.motion.groups import pixel_size as pixel_size
from gsstream.parts.render.activations import rotation_matrices as rotation_matrices
from gsstream.parts.render.backward import rows_backward as rows_backward
from gsstream.parts.residual.rate import rate_gradient as rate_gradient
