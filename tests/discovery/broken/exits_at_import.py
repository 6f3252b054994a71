"""Calls sys.exit where a library should raise."""

import sys

sys.exit("no licence found")
