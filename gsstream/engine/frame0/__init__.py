"""The first frame: seeds, anchors, Gaussians, key packet."""
