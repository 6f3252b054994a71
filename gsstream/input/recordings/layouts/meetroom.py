"""Meet Room (StreamRF): cam_0.mp4 ... cam_12.mp4 beside poses_bounds.npy; or the frames taken out of them.

13 cameras, 1280 x 720, 30 frames per second; the test camera is cam_0, in the middle. Rows of poses_bounds.npy follow
the numbers of the cameras (cam_2 before cam_10), as in StreamRF's preparation.
"""

from functools import partial

from gsstream.input.recordings.layouts.llff import looks_like_llff, read_llff

looks_like = partial(looks_like_llff, pattern="cam_[0-9]*")
read = partial(read_llff, pattern="cam_[0-9]*")
