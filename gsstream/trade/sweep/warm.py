"""What every cell imports, in one module: a fork server loads it once. Starts no thread."""

import torch

import gsstream.engine.assemble
import gsstream.engine.session
import gsstream.trade.bench_report
import gsstream.trade.evaluate  # noqa: F401

#: The first optimiser of a process imports seconds' worth of modules.
torch.optim.Adam([torch.zeros(1)])
