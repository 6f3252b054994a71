"""The changes of a frame: an ordered list, each a frozen record and one numpy function that applies it.

The list of kinds is short and closed, so that every player can play every stream: encoder and player call the same
functions, and a stream never needs a plugin. The arithmetic is +, -, x, / and square root in a stated order and
precision, so that another implementation can agree bit by bit (docs/spec).
"""

from gsstream.core.changes.delta import Change as Change
from gsstream.core.changes.delta import Delta as Delta
from gsstream.core.changes.delta import apply_delta as apply_delta
from gsstream.core.changes.delta import row_gates as row_gates
from gsstream.core.changes.field import Field as Field
from gsstream.core.changes.field import apply_field as apply_field
from gsstream.core.changes.field import field_rows as field_rows
from gsstream.core.changes.hashgrid import FieldShape as FieldShape
from gsstream.core.changes.history import Displacement as Displacement
from gsstream.core.changes.light import Light as Light
from gsstream.core.changes.light import apply_light as apply_light
from gsstream.core.changes.light import lit_background as lit_background
from gsstream.core.changes.light import sendable_factor as sendable_factor
from gsstream.core.changes.motion import Motion as Motion
from gsstream.core.changes.motion import apply_motion as apply_motion
from gsstream.core.changes.motion import groups_for as groups_for
from gsstream.core.changes.residual import Residual as Residual
from gsstream.core.changes.residual import apply_residual as apply_residual
from gsstream.core.changes.residual import changing_rows as changing_rows
from gsstream.core.changes.residual import decode_residual as decode_residual
from gsstream.core.changes.residual import sent_rows as sent_rows
from gsstream.core.changes.rows import AddedGaussians as AddedGaussians
from gsstream.core.changes.rows import RowEdit as RowEdit
from gsstream.core.changes.rows import add_as_nodes as add_as_nodes
from gsstream.core.changes.rows import add_to_nodes as add_to_nodes
from gsstream.core.changes.rows import apply_row_edit as apply_row_edit
from gsstream.core.changes.rows import gather_rows as gather_rows
from gsstream.core.changes.scene import Groups as Groups
from gsstream.core.changes.scene import Layout as Layout
from gsstream.core.changes.scene import Scene as Scene
