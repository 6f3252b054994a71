"""The front door for renderers of a GPU: what they are made of that is recorded once and replayed.

A session that says what a view is made of (:class:`ReplayedSession`) gets its gradients replayed, and its renderer's
optimiser (:class:`ReplayedAdam`) whole passes. Everything else of a renderer comes from ``gsstream.backend``.
"""

from gsstream.parts.backend.replayed_adam import ReplayedAdam as ReplayedAdam
from gsstream.parts.render.replay import Recorder as Recorder
from gsstream.parts.render.replay import RecordError as RecordError
from gsstream.parts.render.replay import Records as Records
from gsstream.parts.render.replay import recorder_on as recorder_on
from gsstream.parts.render.replayed import ReplayedSession as ReplayedSession
from gsstream.parts.render.replayed import SeenView as SeenView
