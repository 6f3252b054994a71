"""gsstream: online free-viewpoint video as a stream of 3D Gaussians.

Importing this package is cheap: it imports neither torch nor a plugin.
"""

__version__ = "0.1.0"

#: Version of the plugin interface (hooks, abstract base classes, Protocols): "major.minor".
#: Another major is refused, a newer minor is refused with "upgrade gsstream", an older minor is fine.
API_VERSION = "2.0"
