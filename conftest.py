"""Settings of every test of the project and its plugins."""

import os

from hypothesis import settings

# A submission is judged by the same examples as the one before it; everywhere else new ones are tried each time, and
# what they find becomes an @example.
# No example has a deadline: how long one takes says how busy the machine is.
settings.register_profile("plain", deadline=None)
settings.register_profile("ci", derandomize=True, deadline=None)
settings.load_profile("ci" if os.environ.get("CI") else "plain")
