"""Features of pictures and matches between them, in COLMAP's database; for ``_pycolmap`` alone.

zlib comes before pycolmap here too: ``_pycolmap`` says why.
"""

from __future__ import annotations

import zlib  # noqa: F401  must precede pycolmap
from collections.abc import Sequence
from itertools import combinations
from pathlib import Path
from typing import Any

import numpy as np
import pycolmap

from gsstream.core.processors import processors

IMAGES = "images"
#: Longer side of the pictures in which features are looked for.
MOST_PIXELS = 1600
#: With more images than this, images that are likely to show the same place are matched first.
MOST_FOR_ALL_PAIRS = 30
#: How far apart they are in the order of their names.
NEIGHBOURS = 10


def extract(folder: Path, most: int, mode: str = "PER_IMAGE", model: str = "SIMPLE_RADIAL") -> Path:
    """Find SIFT features of ``folder/images``, at most ``most`` per image; return the path of the new database.

    Images are worked on at the same time, so they are finished in any order; the database that is returned has them in
    the order of their names, and so the same input gives the same numbers whatever the machine.
    """
    pycolmap.set_random_seed(0)
    scratch, database = folder / "features.db", folder / "database.db"
    extraction, reader = pycolmap.FeatureExtractionOptions(), pycolmap.ImageReaderOptions()
    extraction.num_threads, extraction.use_gpu = processors(), False
    # More pixels find more of the same, and matching them takes minutes.
    extraction.max_image_size = MOST_PIXELS
    # Small images hold little contrast per octave; the stock threshold finds too few points below 640 pixels.
    extraction.sift.peak_threshold, extraction.sift.max_num_features = 0.002, most
    reader.camera_model = model
    names = sorted(path.name for path in (folder / IMAGES).iterdir())
    # Some at a time, to say how many are done. Whoever reads the database meanwhile may lock it, which ends COLMAP.
    step = 2 * extraction.num_threads
    for begin in range(0, len(names), step):
        sign(begin, len(names), "finding features: pictures")
        pycolmap.extract_features(
            scratch,
            folder / IMAGES,
            image_names=names[begin : begin + step],
            camera_mode=getattr(pycolmap.CameraMode, mode),
            reader_options=reader,
            extraction_options=extraction,
        )
        if mode == "SINGLE" and begin == 0:
            with pycolmap.Database.open(scratch) as db:
                reader.existing_camera_id = db.read_all_images()[0].camera_id
    _in_order(scratch, database)
    return database


def _in_order(source: Path, target: Path) -> None:
    """Copy cameras, images and features into a new database, numbered in the order of the images' names."""
    cameras: dict[int, Any] = {}
    rigs: dict[int, int] = {}
    with pycolmap.Database.open(source) as old, pycolmap.Database.open(target) as new:
        for image in sorted(old.read_all_images(), key=lambda image: image.name):
            if image.camera_id not in cameras:
                camera = old.read_camera(image.camera_id)
                camera.camera_id = pycolmap.INVALID_CAMERA_ID
                camera.camera_id = new.write_camera(camera)
                rig = pycolmap.Rig()
                rig.add_ref_sensor(camera.sensor_id)
                cameras[image.camera_id], rigs[image.camera_id] = camera, new.write_rig(rig)
            own = pycolmap.Image(name=image.name, camera_id=cameras[image.camera_id].camera_id)
            own.image_id = number = new.write_image(own)
            frame = pycolmap.Frame()
            frame.rig_id = rigs[image.camera_id]
            frame.add_data_id(own.data_id)
            new.write_frame(frame)
            new.write_keypoints(number, old.read_keypoints(image.image_id))
            new.write_descriptors(number, old.read_descriptors(image.image_id))


def sign(done: int, total: int, what: str) -> None:
    """Tell the process that waits for this one how far the work is."""
    print("sign", done, total, what, flush=True)


def match_pairs(folder: Path, database: Path, pairs: Sequence[tuple[str, str]]) -> None:
    """Match pairs of images, by their names, and verify each pair's geometry; the same for the same input.

    With two threads or more, about one matching in fifty of pycolmap 4.2 finds other matches than all the others do:
    the searches of its threads disturb each other. Its exhaustive search does not, and takes a hundred times as long.
    """
    matching, verification = pycolmap.FeatureMatchingOptions(), pycolmap.TwoViewGeometryOptions()
    matching.num_threads, matching.use_gpu = 1, False
    verification.ransac.random_seed = 0
    pairing = pycolmap.ImportedPairingOptions()
    pairing.match_list_path = folder / "pairs.txt"
    step = 8
    for begin in range(0, len(pairs), step):
        sign(begin, len(pairs), "matching features: pairs of pictures")
        pairing.match_list_path.write_text("".join(f"{a} {b}\n" for a, b in pairs[begin : begin + step]))
        pycolmap.match_image_pairs(
            database, matching_options=matching, pairing_options=pairing, verification_options=verification
        )


def all_pairs(folder: Path) -> list[tuple[str, str]]:
    """Return every pair of images."""
    return list(combinations(sorted(path.name for path in (folder / IMAGES).iterdir()), 2))


def pairs_in_order(names: Sequence[str]) -> list[tuple[str, str]]:
    """Return the pairs of images that are likely to show the same, if these were taken one after the other.

    They are up to NEIGHBOURS places apart, or a power of two. After the last one comes the first: a walk around.
    """
    count = len(names)
    apart = {gap for gap in range(1, count // 2 + 1) if gap <= NEIGHBOURS or gap & (gap - 1) == 0}
    return [(names[a], names[b]) for a, b in combinations(range(count), 2) if min(b - a, count - b + a) in apart]


def pairs_by_place(names: Sequence[str], viewmats: Any) -> list[tuple[str, str]]:
    """Return each image with those that were taken nearest to it."""
    centers = -np.einsum("cji,cj->ci", viewmats[:, :3, :3], viewmats[:, :3, 3])
    distance = np.linalg.norm(centers[:, None] - centers[None], axis=2)
    nearest = np.argsort(distance, axis=1, kind="stable")[:, 1 : 2 * NEIGHBOURS + 1]
    found = {(min(a, int(b)), max(a, int(b))) for a, row in enumerate(nearest) for b in row}
    return [(names[a], names[b]) for a, b in sorted(found)]
