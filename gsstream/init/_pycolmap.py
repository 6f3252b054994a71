"""The one module that imports pycolmap. Run as ``python -m gsstream.init._pycolmap FOLDER`` in a process of its own.

zlib comes first on purpose: pycolmap 4.1 and later carry a zlib of their own, and when they are the first to load the
system's one, the two mix and the next compression corrupts the heap. Loaded first, the system's zlib binds to itself.
"""

from __future__ import annotations

import zlib  # noqa: F401  must precede pycolmap, see above
from pathlib import Path
from typing import Any

import numpy as np
import pycolmap

IMAGES, RIG, RESULT = "images", "rig.npz", "points.npz"


def triangulate(folder: Path) -> None:
    """Triangulate SIFT matches of ``folder/images/*.png`` with the known poses of ``folder/rig.npz``.

    Writes ``folder/points.npz``: xyz [P, 3] float64, rgb [P, 3] uint8, error [P] pixels, track [P] views.
    Deterministic: one thread and fixed seeds everywhere. SIFT only: the wheel's learned features end the process.
    """
    pycolmap.set_random_seed(0)
    database = folder / "database.db"
    extraction = pycolmap.FeatureExtractionOptions()
    extraction.num_threads, extraction.use_gpu = 1, False
    # Small images hold little contrast per octave; the stock threshold finds too few points below 640 pixels.
    extraction.sift.peak_threshold = 0.002
    pycolmap.extract_features(
        database, folder / IMAGES, camera_mode=pycolmap.CameraMode.PER_IMAGE, extraction_options=extraction
    )
    with np.load(folder / RIG) as rig, pycolmap.Database.open(database) as db:
        reconstruction = _known_rig(db, rig["viewmats"], rig["Ks"], *map(int, rig["size"]))
    matching, verification = pycolmap.FeatureMatchingOptions(), pycolmap.TwoViewGeometryOptions()
    matching.num_threads, matching.use_gpu = 1, False
    verification.ransac.random_seed = 0
    pycolmap.match_exhaustive(database, matching_options=matching, verification_options=verification)
    options = pycolmap.IncrementalPipelineOptions()
    options.num_threads, options.random_seed = 1, 0
    sparse = folder / "sparse"
    sparse.mkdir()
    points = pycolmap.triangulate_points(reconstruction, database, folder / IMAGES, sparse, options=options).points3D
    order = sorted(points)
    np.savez(
        folder / RESULT,
        xyz=np.array([points[i].xyz for i in order]).reshape(-1, 3),
        rgb=np.array([points[i].color for i in order], np.uint8).reshape(-1, 3),
        error=np.array([points[i].error for i in order]),
        track=np.array([points[i].track.length() for i in order], np.int64),
    )


def _known_rig(db: Any, viewmats: Any, Ks: Any, width: int, height: int) -> Any:
    """A reconstruction without points whose cameras and poses are the given ones, with the database's numbering."""
    reconstruction = pycolmap.Reconstruction()
    for image in db.read_all_images():
        index = int(Path(image.name).stem)
        K = Ks[index]
        camera = db.read_camera(image.camera_id)
        camera.model = pycolmap.CameraModelId.PINHOLE
        camera.width, camera.height = width, height
        camera.params = [K[0, 0], K[1, 1], K[0, 2], K[1, 2]]
        camera.has_prior_focal_length = True
        db.update_camera(camera)
        reconstruction.add_camera_with_trivial_rig(camera)
        pose = pycolmap.Rigid3d(viewmats[index, :3])
        keyed = pycolmap.Image(name=image.name, camera_id=image.camera_id, image_id=image.image_id)
        reconstruction.add_image_with_trivial_frame(keyed, pose)
    return reconstruction


if __name__ == "__main__":
    import sys

    triangulate(Path(sys.argv[1]))
