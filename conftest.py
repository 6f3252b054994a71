"""Settings of every test of the project and its plugins."""

import os

from hypothesis import settings

# A submission is judged by the same examples as the one before it; everywhere else new ones are tried each time, and
# what they find becomes an @example.
settings.register_profile("ci", derandomize=True)
if os.environ.get("CI"):
    settings.load_profile("ci")
