"""What every cell imports, in one module: a fork server loads it once. Starts no thread."""

import gsstream.engine.assembly.assemble
import gsstream.engine.run.session
import gsstream.evaluation.evaluate  # noqa: F401
