"""Functions that the engine itself is built from, for methods and parts that do more than fill a slot.

``gsstream.api`` has the nouns (records and contracts); these are the functions that such a method would otherwise
copy: densify, count changed tiles, learn residuals side by side, weigh their rate, judge a view, fit a packet.
"""

from gsstream.core.changes.motion import Moves as Moves
from gsstream.core.changes.motion import matrices_of as matrices_of
from gsstream.core.changes.motion import moves_of as moves_of
from gsstream.core.changes.motion import multiply as multiply
from gsstream.core.changes.motion import quats_of as quats_of
from gsstream.core.changes.motion import transformed as transformed
from gsstream.core.changes.rows import gather_rows as gather_rows
from gsstream.engine.budget.trim import Fitted as Fitted
from gsstream.engine.fit.densify import SPLIT_SIZE as SPLIT_SIZE
from gsstream.engine.fit.densify import DensifyStatistics as DensifyStatistics
from gsstream.engine.fit.densify import children as children
from gsstream.engine.fit.nearest import nearest_among as nearest_among
from gsstream.engine.fit.nearest import nearest_rows as nearest_rows
from gsstream.engine.fit.nearest import neighbour_distance as neighbour_distance
from gsstream.engine.step.active.candidates import changed_rows as changed_rows
from gsstream.engine.step.active.candidates import rows_in_change as rows_in_change
from gsstream.engine.step.active.change import Change as Change
from gsstream.engine.step.active.change import detect_change as detect_change
from gsstream.engine.step.active.change import marked_per_tile as marked_per_tile
from gsstream.engine.step.harden import rows_of as rows_of
from gsstream.parts.growth.copying import Admitted as Admitted
from gsstream.parts.growth.copying import fitted_copies as fitted_copies
from gsstream.parts.growth.copying import pulled_rows as pulled_rows
from gsstream.parts.growth.copying import replaced_by_copies as replaced_by_copies
from gsstream.parts.growth.fitting import fitted_births as fitted_births
from gsstream.parts.growth.fitting import joined as joined
from gsstream.parts.motion.field import said_by_cells as said_by_cells
from gsstream.parts.motion.fitting import Descent as Descent
from gsstream.parts.motion.fitting import each_alone as each_alone
from gsstream.parts.motion.fitting import felt_most as felt_most
from gsstream.parts.motion.fitting import fitted_moves as fitted_moves
from gsstream.parts.motion.groups import groups_within as groups_within
from gsstream.parts.motion.groups import pixel_size as pixel_size
from gsstream.parts.optimiser.joint import add_joint as add_joint
from gsstream.parts.optimiser.joint import decode_joint as decode_joint
from gsstream.parts.optimiser.joint import join_features as join_features
from gsstream.parts.optimiser.joint import joint_vjp as joint_vjp
from gsstream.parts.optimiser.rate import rate_gradient as rate_gradient
from gsstream.parts.optimiser.row_parameters import RowParameters as RowParameters
from gsstream.parts.render.activations import activate_opacities as activate_opacities
from gsstream.parts.render.activations import activate_scales as activate_scales
from gsstream.parts.render.activations import logit as logit
from gsstream.parts.render.activations import rgb_to_sh0 as rgb_to_sh0
from gsstream.parts.render.backward import backward as backward
from gsstream.parts.render.backward import rows_backward as rows_backward
from gsstream.parts.update.base import MAX_SYMBOL as MAX_SYMBOL
from gsstream.parts.update.joint import JointCode as JointCode
from gsstream.parts.update.joint import joint_code as joint_code
