"""All that calls pycolmap, with ``_features``: ``python -m gsstream.input.seeds._pycolmap TASK FOLDER``, a process.

zlib comes first on purpose: pycolmap 4.1 and later carry a zlib of their own, and when they are the first to load the
system's one, the two mix and the next compression corrupts the heap. Loaded first, the system's zlib binds to itself.
"""

from __future__ import annotations

import itertools
import os
import zlib  # noqa: F401  must precede pycolmap, see above
from pathlib import Path
from typing import Any

import numpy as np

# Read when the libraries of pycolmap are loaded. How many threads their linear algebra takes depends on what other
# threads do at that moment, and the last bits of its sums on that number. Pictures are still worked on at the
# same time, by threads of COLMAP's own; pairs are matched one after the other (`match_pairs`).
os.environ |= dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1")

import pycolmap

from gsstream.input.seeds._features import (
    IMAGES,
    MOST_FOR_ALL_PAIRS,
    all_pairs,
    extract,
    match_pairs,
    pairs_by_place,
    pairs_in_order,
    sign,
)

RIG, RESULT, MATCHES = "rig.npz", "points.npz", "matches.npz"


def triangulate(folder: Path) -> None:
    """Triangulate SIFT matches of ``folder/images/*.png`` with the known poses of ``folder/rig.npz``.

    Writes ``folder/points.npz``: xyz [P, 3] float64, rgb [P, 3] uint8, error [P] pixels, track [P] views.
    Deterministic: fixed seeds, features in the order of names, one thread for all else. SIFT only: the wheel's learned
    features end the process.
    """
    database = extract(folder, most=8192)
    with np.load(folder / RIG) as rig, pycolmap.Database.open(database) as db:
        reconstruction = _known_rig(db, rig["viewmats"], rig["Ks"], *map(int, rig["size"]))
        names = sorted(image.name for image in db.read_all_images())
        pairs = all_pairs(folder) if len(names) <= MOST_FOR_ALL_PAIRS else pairs_by_place(names, rig["viewmats"])
    match_pairs(folder, database, pairs)
    sign(0, 0, "triangulating points")
    options = pycolmap.IncrementalPipelineOptions()
    options.num_threads, options.random_seed = 1, 0
    sparse = folder / "sparse"
    sparse.mkdir()
    reconstruction = pycolmap.triangulate_points(reconstruction, database, folder / IMAGES, sparse, options=options)
    np.savez(folder / RESULT, **_points_of(reconstruction))


def match(folder: Path) -> None:
    """Find verified matches of ``folder/images``.

    They are pairs [K, 2], counts [K], first and second [sum of counts, 2] pixels.

    Writes ``folder/matches.npz``. Nothing is known about the cameras, so each pair is verified without calibration.
    """
    database = extract(folder, most=2048)
    match_pairs(folder, database, all_pairs(folder))
    pairs, counts, first, second = [], [], [np.zeros((0, 2))], [np.zeros((0, 2))]
    with pycolmap.Database.open(database) as db:
        images = sorted(db.read_all_images(), key=lambda image: image.name)
        keypoints = [np.asarray(db.read_keypoints(image.image_id), np.float64)[:, :2] for image in images]
        for a in range(len(images)):
            for b in range(a + 1, len(images)):
                ids = images[a].image_id, images[b].image_id
                if not db.exists_two_view_geometry(*ids):
                    continue
                inliers = np.asarray(db.read_two_view_geometry(*ids).inlier_matches, np.int64).reshape(-1, 2)
                pairs.append((a, b))
                counts.append(len(inliers))
                first.append(keypoints[a][inliers[:, 0]])
                second.append(keypoints[b][inliers[:, 1]])
    np.savez(
        folder / MATCHES,
        pairs=np.array(pairs, np.int64).reshape(-1, 2),
        counts=np.array(counts, np.int64),
        first=np.concatenate(first),
        second=np.concatenate(second),
    )


def _points_of(reconstruction: Any) -> dict[str, Any]:
    """All points, and which image saw each: ``seen_point`` [S], ``seen_image`` [S], ``seen_error`` [S] pixels.

    An image is given by the number in its name.
    """
    points = [point for _, point in sorted(reconstruction.points3D.items())]
    row, image, off = [], [], []
    for number, point in enumerate(points):
        for element in point.track.elements:
            shown = reconstruction.images[element.image_id]
            row.append(number)
            image.append(int(Path(shown.name).stem))
            there = shown.project_point(point.xyz)
            off.append(np.inf if there is None else np.linalg.norm(there - shown.points2D[element.point2D_idx].xy))
    return {
        "xyz": np.array([point.xyz for point in points]).reshape(-1, 3),
        "rgb": np.array([point.color for point in points], np.uint8).reshape(-1, 3),
        "error": np.array([point.error for point in points]),
        "track": np.array([point.track.length() for point in points], np.int64),
        "seen_point": np.array(row, np.int64),
        "seen_image": np.array(image, np.int64),
        "seen_error": np.array(off, np.float64),
    }


def _known_rig(db: Any, viewmats: Any, Ks: Any, width: int, height: int) -> Any:
    """A reconstruction without points whose cameras and poses are the given ones, with the database's numbering."""
    reconstruction = pycolmap.Reconstruction()
    for image in sorted(db.read_all_images(), key=lambda image: image.name):
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


def reconstruct(folder: Path) -> None:
    """Find poses, intrinsics and points from ``folder/images/*.png`` and what ``folder/job.npz`` asks for.

    job: model (COLMAP's name), shared (one camera for all), held (numbers of images that take no part in the mapping:
    they are registered against the finished points, which they do not change).

    Writes ``folder/points.npz`` (as :func:`triangulate`) with viewmats [C, 4, 4] (NaN: not registered) and params.
    """
    with np.load(folder / "job.npz") as job:
        model, shared, held = str(job["model"]), bool(job["shared"]), {int(i) for i in job["held"]}
    database = extract(folder, most=4096, mode="SINGLE" if shared else "PER_IMAGE", model=model)
    names = sorted(path.name for path in (folder / IMAGES).iterdir())
    pairs = all_pairs(folder) if len(names) <= MOST_FOR_ALL_PAIRS else pairs_in_order(names)
    match_pairs(folder, database, pairs)
    with pycolmap.Database.open(database) as db:
        images = {int(Path(image.name).stem): image for image in db.read_all_images()}
        known = {index: db.read_camera(image.camera_id) for index, image in images.items()}
    free = [image.name for index, image in sorted(images.items()) if index not in held]
    best = _map(folder, database, free, "first")
    rest = sorted(set(all_pairs(folder)) - set(pairs))
    if rest and (best is None or best.num_reg_images() < len(free)):
        match_pairs(folder, database, rest)  # they were not taken one after the other
        best = _map(folder, database, free, "second")
    if best is None:
        np.savez(folder / "apart.npz", **_matches_of(database))
        return
    mapped = [image for _, image in sorted(best.images.items())]
    poses = {int(Path(image.name).stem): image.cam_from_world() for image in mapped if image.has_pose}
    cameras = {int(Path(image.name).stem): best.cameras[image.camera_id] for image in mapped}
    held_error = np.full(len(images), np.nan)
    for index in sorted(held):
        camera = next(iter(best.cameras.values())) if shared else known[index]
        poses[index], held_error[index] = _register(
            database, images, best, index=index, camera=camera, refine=not shared
        )
        cameras[index] = camera
    viewmats = np.full((len(images), 4, 4), np.nan)
    for index, pose in poses.items():
        if pose is not None:
            viewmats[index] = np.vstack([pose.matrix(), (0, 0, 0, 1)])
    np.savez(
        folder / RESULT,
        viewmats=viewmats,
        held_error=held_error,
        cameras=np.array([cameras.get(index, known[index]).params for index in sorted(images)]),
        **_points_of(best),
    )


def _matches_of(database: Path) -> dict[str, Any]:
    """Verified matches of each pair of images: ``pairs`` [K, 2] by the numbers in their names, ``counts`` [K]."""
    with pycolmap.Database.open(database) as db:
        images = sorted((int(Path(image.name).stem), image.image_id) for image in db.read_all_images())
        pairs, counts = [], []
        for (a, first), (b, second) in itertools.combinations(images, 2):
            known = db.exists_two_view_geometry(first, second)
            pairs.append((a, b))
            counts.append(len(db.read_two_view_geometry(first, second).inlier_matches) if known else 0)
    return {"pairs": np.array(pairs, np.int64).reshape(-1, 2), "counts": np.array(counts, np.int64)}


def _map(folder: Path, database: Path, names: list[str], turn: str) -> Any:
    """The mapping with most images, then least error, over a few settings: stock ones fail on few small images.

    None where no pair of images shares enough to begin with.
    """
    placed = itertools.count(3)
    best, rank = None, (0, 0.0)
    for attempt, (inliers, angle, least) in enumerate(((100, 16.0, 30), (40, 8.0, 15))):
        options = pycolmap.IncrementalPipelineOptions()
        options.num_threads, options.random_seed, options.min_model_size = 1, 0, 2
        options.image_names = names
        options.mapper.init_min_num_inliers, options.mapper.init_min_tri_angle = inliers, angle
        options.mapper.abs_pose_min_num_inliers = least
        sparse = folder / f"sparse-{turn}-{attempt}"
        sparse.mkdir()
        sign(0, 0, "placing cameras")
        mapped = pycolmap.incremental_mapping(
            database,
            folder / IMAGES,
            sparse,
            options=options,
            next_image_callback=lambda: sign(min(next(placed), len(names)), len(names), "placing cameras: placed"),
        )
        for made in mapped.values():
            score = (made.num_reg_images(), -made.compute_mean_reprojection_error())
            if best is None or score > rank:
                best, rank = made, score
        if rank[0] == len(names):
            break
    return best


def _register(database: Path, images: Any, best: Any, index: int, camera: Any, refine: bool) -> Any:
    """Pose of an image from its matches with mapped images, and its error in pixels; (None, nan) without a pose.

    ``refine``: the camera's focal length and distortion are fitted too, in place.
    """
    flat, solid = [], []
    mine = images[index]
    with pycolmap.Database.open(database) as db:
        keypoints = np.asarray(db.read_keypoints(mine.image_id), np.float64)[:, :2]
        for _, other in sorted(best.images.items()):
            if not db.exists_two_view_geometry(mine.image_id, other.image_id):
                continue
            matches = np.asarray(db.read_two_view_geometry(mine.image_id, other.image_id).inlier_matches, np.int64)
            for here, there in matches.reshape(-1, 2):
                point = other.points2D[int(there)]
                if point.has_point3D():
                    flat.append(keypoints[here])
                    solid.append(best.points3D[point.point3D_id].xyz)
    if len(flat) < 12:
        return None, np.nan
    estimation, refinement = pycolmap.AbsolutePoseEstimationOptions(), pycolmap.AbsolutePoseRefinementOptions()
    estimation.ransac.random_seed = 0
    estimation.estimate_focal_length = refine
    refinement.refine_focal_length = refinement.refine_extra_params = refine
    found = pycolmap.estimate_and_refine_absolute_pose(
        np.array(flat), np.array(solid), camera, estimation_options=estimation, refinement_options=refinement
    )
    if found is None:
        return None, np.nan
    inside = np.asarray(found["inlier_mask"], bool)
    local = np.array([found["cam_from_world"] * xyz for xyz in np.array(solid)[inside]])
    off = np.linalg.norm(camera.img_from_cam(local) - np.array(flat)[inside], axis=1)
    return found["cam_from_world"], float(off.mean())


TASKS = {"triangulate": triangulate, "match": match, "reconstruct": reconstruct}

if __name__ == "__main__":
    import sys

    TASKS[sys.argv[1]](Path(sys.argv[2]))
