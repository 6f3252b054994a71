"""Functions that the engine itself is built from, for methods and parts that do more than fill a slot.

``gsstream.api`` has the nouns (records and contracts); these are the functions that such a method would otherwise
copy: densify, count changed tiles, learn residuals side by side, weigh their rate, compare a view, fit a packet.
"""

from gsstream.core.changes.motion import GroupTransforms as GroupTransforms
from gsstream.core.changes.motion import predict_transforms as predict_transforms
from gsstream.core.changes.motion import quat_multiply as quat_multiply
from gsstream.core.changes.motion import quat_to_rotmat as quat_to_rotmat
from gsstream.core.changes.motion import rodrigues_to_quat as rodrigues_to_quat
from gsstream.core.changes.motion import transform_groups as transform_groups
from gsstream.core.changes.rows import gather_rows as gather_rows
from gsstream.core.picture_size import bit_price_factor as bit_price_factor
from gsstream.core.picture_size import enlargement as enlargement
from gsstream.engine.fit.densify import SPLIT_SIZE as SPLIT_SIZE
from gsstream.engine.fit.densify import DensifyStatistics as DensifyStatistics
from gsstream.engine.fit.densify import split_or_clone as split_or_clone
from gsstream.engine.fit.nearest import k_nearest as k_nearest
from gsstream.engine.fit.nearest import nearest_rows as nearest_rows
from gsstream.engine.fit.nearest import neighbour_distance as neighbour_distance
from gsstream.engine.step.active.candidates import changed_rows as changed_rows
from gsstream.engine.step.active.change import Change as Change
from gsstream.engine.step.active.change import count_per_tile as count_per_tile
from gsstream.engine.step.active.change import detect_changed_tiles as detect_changed_tiles
from gsstream.engine.step.quantise import gather_rows_or_zero as gather_rows_or_zero
from gsstream.parts.growth.copying import CopyFilter as CopyFilter
from gsstream.parts.growth.copying import CopySettings as CopySettings
from gsstream.parts.growth.copying import high_gradient_rows as high_gradient_rows
from gsstream.parts.growth.copying import least_opaque as least_opaque
from gsstream.parts.growth.copying import replace_with_copies as replace_with_copies
from gsstream.parts.growth.fitting import concat_gaussians as concat_gaussians
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
from gsstream.parts.render.activations import activate_opacities as activate_opacities
from gsstream.parts.render.activations import activate_scales as activate_scales
from gsstream.parts.render.activations import logit as logit
from gsstream.parts.render.activations import rgb_to_sh0 as rgb_to_sh0
from gsstream.parts.render.activations import rotation_matrices as rotation_matrices
from gsstream.parts.render.backward import backward as backward
from gsstream.parts.render.backward import rows_backward as rows_backward
from gsstream.parts.residual.decode import add_joint as add_joint
from gsstream.parts.residual.decode import decode_joint as decode_joint
from gsstream.parts.residual.decode import join_features as join_features
from gsstream.parts.residual.decode import joint_vjp as joint_vjp
from gsstream.parts.residual.layout import JointLayout as JointLayout
from gsstream.parts.residual.layout import joint_layout as joint_layout
from gsstream.parts.residual.rate import rate_gradient as rate_gradient
from gsstream.parts.residual.row_parameters import RowParameters as RowParameters
from gsstream.parts.update.base import MAX_SYMBOL as MAX_SYMBOL
