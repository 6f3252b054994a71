"""An analytic moving scene with exact truth and any number of frames: ray-cast shapes in a room, no Gaussians."""

from __future__ import annotations

import threading
from collections.abc import Sequence

import numpy as np
from pydantic import BaseModel, ConfigDict, Field

from gsstream.core.cameras import Cameras
from gsstream.core.frame import Frame, PointCloud
from gsstream.core.rng import Rng
from gsstream.core.shapes import BoolArray, FloatArray
from gsstream.input.recordings.base import PointKind, Source, SourceInfo, Split, assembled, check_index
from gsstream.input.recordings.images import scaled_size
from gsstream.input.recordings.options import options_of_query
from gsstream.input.recordings.primitives import Hits, Placed, cast, lit
from gsstream.input.recordings.toyroom import LIGHT, arc_cameras
from gsstream.input.recordings.toyscenes import SceneName, ToyScene

_AMBIENT = np.float32(0.45)
_POINT_STRIDE = 3
_SPARSE_SHARE = 5


class SyntheticOptions(BaseModel):
    """Options of ``synthetic:key=value&...``."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    scene: SceneName = Field(
        default="paths",
        description="what happens. paths: two objects on smooth paths; at frame 'event' they stop (stop) or turn back "
        "(reversal), or the light flashes for that frame (flash), is brighter from it on (lamp), or falls slowly from "
        "it on, everywhere (dim) or on one side of the room (cloud); a ball bounces off the floor (bounce) or goes "
        "through a tunnel (occlusion)",
    )
    event: int = Field(default=8, ge=1, le=100_000, description="the frame at which the scene's event happens")
    frames: int = Field(default=40, ge=1, description="number of frames")
    views: int = Field(default=8, ge=2, le=64, description="training cameras; one test camera stands in their middle")
    width: int = Field(default=160, ge=8, le=4096, description="image width in pixels")
    height: int = Field(default=120, ge=8, le=4096, description="image height in pixels")
    seed: int = Field(default=0, ge=0, description="seed of textures, starting phase and noise")
    motion: float = Field(default=1.0, ge=0, le=20, description="speed; at 1 an object goes about 8 cm a frame")
    static: bool = Field(default=False, description="nothing moves (noise stays)")
    noise: float = Field(default=0.0, ge=0, le=0.5, description="standard deviation of image noise, full scale 1")
    shadows: bool = Field(default=True, description="objects cast shadows")
    supersample: int = Field(default=2, ge=1, le=8, description="rays per pixel side")


class SyntheticSource(Source):
    """Objects move on known paths among static ones, inside a textured room; all surfaces are finite.

    Images are quantised to 8 bits after noise. Thread-safe; the same options give the same bits.
    """

    def __init__(self, options: SyntheticOptions, *, scale: float = 1.0, uri: str = "synthetic:") -> None:
        self._options = options
        width, height = scaled_size((options.width, options.height), scale)
        rig = arc_cameras(options.views, width, height)
        self._info = SourceInfo(
            name="synthetic",
            uri=uri,
            num_frames=options.frames,
            fps=30.0,
            train=rig.select(range(1, options.views + 1)),
            test=rig.select([0]),
            licence="made by this package",
        )
        self._scene = ToyScene(options.scene, options.seed, 0.0 if options.static else options.motion, options.event)
        self._static: list[Placed] = self._scene.static()
        self._background: dict[str, tuple[FloatArray, Hits, FloatArray]] = {}
        self._lock = threading.Lock()

    @classmethod
    def from_query(cls, query: str, *, scale: float = 1.0, uri: str | None = None) -> SyntheticSource:
        """Build from ``"frames=40&views=8"``. Raises SourceError naming the option that is unknown or out of range."""
        options = options_of_query(SyntheticOptions, query.lstrip("?"), "synthetic source")
        return cls(options, scale=scale, uri=f"synthetic:{query}" if uri is None else uri)

    @property
    def info(self) -> SourceInfo:
        """What the recording says about itself."""
        return self._info

    def frame(self, index: int, split: Split = "train") -> Frame:
        """Ray-cast one instant. Raises SourceError for an index outside the recording."""
        return self.stored_frame(index, split).as_float32()

    def image(self, index: int, camera: str) -> FloatArray:
        """Ray-cast one camera's image. Raises SourceError for an index outside the recording."""
        check_index(self._info, index)
        rig = self._info.train if camera in self._info.train.ids else self._info.test
        return self._image(rig, rig.ids.index(camera), index)

    def stored_frame(self, index: int, split: Split = "train") -> Frame:
        """Ray-cast one instant, with images of uint8."""
        return assembled(self, index, split)

    @property
    def stores_bytes(self) -> bool:
        """True: images are quantised to 8 bits."""
        return True

    def points(self, kind: PointKind = "recording") -> PointCloud:
        """Return points on the surfaces seen by the training cameras at frame 0.

        "recording": every third pixel, 2 mm noise per axis; "sparse": a random fifth of them with 5 mm (1 unit = 1 m).
        """
        points = self.points_without((), kind)
        assert points is not None, "every camera sees a surface"
        return points

    def points_without(self, cameras: Sequence[str], kind: PointKind = "recording") -> PointCloud | None:
        """Return those of the points that no camera named here has seen; None when none are left."""
        frame, depth = self.frame(0), self.depth(0)
        rows = slice(_POINT_STRIDE // 2, None, _POINT_STRIDE)
        views = [i for i, name in enumerate(frame.cameras.ids) if name not in cameras]
        if not views:
            return None
        clouds = []
        for i in views:
            origin, rays = _camera_rays(frame.cameras, i, 1)
            hits = (origin + rays * depth[i].reshape(-1, 1)).reshape(*depth[i].shape, 3)
            clouds.append(hits[rows, rows].reshape(-1, 3))
        xyz, rgb = np.concatenate(clouds), frame.images[views][:, rows, rows].reshape(-1, 3)
        rng = Rng(self._options.seed).numpy("synthetic points")
        if kind == "sparse":
            chosen = np.sort(rng.permutation(len(xyz))[: len(xyz) // _SPARSE_SHARE])
            xyz, rgb = xyz[chosen], rgb[chosen]
        xyz = xyz + rng.normal(0, 0.002 if kind == "recording" else 0.005, xyz.shape)
        return PointCloud(xyz.astype(np.float32), rgb.astype(np.float32), f"synthetic surfaces ({kind})")

    def object_positions(self, index: int) -> dict[str, FloatArray]:
        """Return the true centre [3] of each moving object at a frame, scene units."""
        check_index(self._info, index)
        return self._scene.centers(index)

    def depth(self, index: int, split: Split = "train") -> FloatArray:
        """Return the true planar depth [C, H, W] float32 at the pixel centres, scene units."""
        check_index(self._info, index)
        cameras = self._info.train if split == "train" else self._info.test
        shapes = self._static + self._scene.moving(index)
        depths = [cast(*_camera_rays(cameras, i, 1), shapes).distance for i in range(len(cameras))]
        return np.stack(depths).reshape(len(cameras), cameras.height, cameras.width)

    def moving_mask(self, index: int, split: Split = "train") -> BoolArray:
        """Return [C, H, W] bool: pixels of which some ray meets a moving object (its shadow excluded)."""
        check_index(self._info, index)
        cameras = self._info.train if split == "train" else self._info.test
        n = self._options.supersample
        masks = []
        for i in range(len(cameras)):
            rays, behind, _ = self._backdrop(cameras, i)
            moving = cast(cameras.centers[i], rays, self._scene.moving(index))
            nearer = (moving.distance < behind.distance).reshape(cameras.height, n, cameras.width, n)
            masks.append(nearer.any(axis=(1, 3)))
        return np.stack(masks)

    def close(self) -> None:
        """Drop the cached background."""
        with self._lock:
            self._background.clear()

    def _image(self, cameras: Cameras, i: int, index: int) -> FloatArray:
        rays, behind, light = self._backdrop(cameras, i)
        origin = cameras.centers[i]
        shapes = self._scene.moving(index)
        moving = cast(origin, rays, shapes)
        front = moving.distance < behind.distance
        albedo = np.where(front[:, None], moving.albedo, behind.albedo)
        light = light.copy()
        light[front] = np.maximum(moving.normal[front] @ LIGHT, 0)
        distance = np.minimum(moving.distance, behind.distance)
        if self._options.shadows:
            self._cast_shadows(origin, rays, distance, front=front, light=light, shapes=shapes)
        colors = albedo * (_AMBIENT + (1 - _AMBIENT) * light)[:, None] * np.float32(self._scene.light(index))
        if self._options.scene == "cloud":
            colors *= self._scene.shade(index, origin + rays * distance[:, None])[:, None]
        n = self._options.supersample
        fine = colors.reshape(cameras.height, n, cameras.width, n, 3)
        image = sum(fine[:, y, :, x] for y in range(n) for x in range(n)) / np.float32(n * n)
        if self._options.noise > 0:
            rng = Rng(self._options.seed).numpy(f"synthetic noise {cameras.ids[i]}", index)
            image = image + rng.standard_normal(image.shape, np.float32) * np.float32(self._options.noise)
        quantised: FloatArray = np.round(np.clip(image, 0, 1) * np.float32(255)) / np.float32(255)
        return quantised.astype(np.float32)

    def _cast_shadows(
        self,
        origin: FloatArray,
        rays: FloatArray,
        distance: FloatArray,
        front: BoolArray,
        light: FloatArray,
        shapes: list[Placed],
    ) -> None:
        """Take the light from ``light`` where moving shapes shade anything, or static ones shade the moving."""
        bright = np.flatnonzero(light > 0)
        points = origin.astype(np.float32) + rays[bright] * distance[bright, None] + np.float32(2e-3) * LIGHT
        light[bright[~lit(points, LIGHT, shapes)]] = 0
        on_moving = np.flatnonzero(front & (light > 0))
        points = origin.astype(np.float32) + rays[on_moving] * distance[on_moving, None] + np.float32(2e-3) * LIGHT
        light[on_moving[~lit(points, LIGHT, self._static[1:])]] = 0

    def _backdrop(self, cameras: Cameras, i: int) -> tuple[FloatArray, Hits, FloatArray]:
        """Rays, static hits and their light, computed once per camera: only what moves is cast in every frame."""
        name = cameras.ids[i]
        with self._lock:
            if name not in self._background:
                origin, rays = _camera_rays(cameras, i, self._options.supersample)
                hits = cast(origin, rays, self._static)
                light = np.maximum(hits.normal @ LIGHT, 0)
                if self._options.shadows:
                    points = origin.astype(np.float32) + rays * hits.distance[:, None] + np.float32(2e-3) * LIGHT
                    light[~lit(points, LIGHT, self._static[1:])] = 0
                self._background[name] = rays, hits, light
            return self._background[name]


def _camera_rays(cameras: Cameras, i: int, per_side: int) -> tuple[FloatArray, FloatArray]:
    """Centre [3] and rays [H n W n, 3] float32 with unit planar depth, so that a ray parameter is a depth."""
    steps = (np.arange(per_side) + 0.5) / per_side
    x = (np.arange(cameras.width)[:, None] + steps).ravel()
    y = (np.arange(cameras.height)[:, None] + steps).ravel()
    u, v = np.meshgrid(x, y)
    pixels = np.stack([u.ravel(), v.ravel(), np.ones(u.size)], axis=1)
    rays = pixels @ np.linalg.inv(cameras.Ks[i]).T @ cameras.viewmats[i, :3, :3]
    return cameras.centers[i], rays.astype(np.float32)
