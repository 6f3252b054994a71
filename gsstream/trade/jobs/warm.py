"""What every cell imports, in one module: a fork server loads it once. Starts no thread."""

import gsstream.engine.assembly.assemble
import gsstream.engine.run.session
import gsstream.trade.jobs.machine
import gsstream.trade.measure.evaluate  # noqa: F401
