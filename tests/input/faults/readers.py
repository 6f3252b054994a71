"""Small sound recordings, one for every reader and every way in which it takes pictures, and what can be done to them.

A recording has ``FRAMES`` instants and lies as its program leaves it; ``at`` says where a picture or a video is.
"""

from __future__ import annotations

import json
import re
import shutil
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from tests.input.recordings import tiny_recordings
from tests.input.recordings.test_rigs import FORMATS, HEIGHT, NAMES, WIDTH
from tests.input.recordings.tiny_recordings import World, write_frames, write_video

FRAMES, RATE = 12, 25
Edit = Callable[[Path], None]
#: What is done to a calibration, or why it cannot be.
Edits = Mapping[str, Edit | str]


@dataclass(frozen=True)
class Reader:
    """How a sound recording is written, where its pictures lie, and how its calibration is spoiled."""

    write: Edit
    scheme: str
    cameras: tuple[str, ...]
    #: Path of a camera's picture or film; {c} is the camera, {t} the number of the instant.
    at: str
    file: str  # the calibration
    edits: Edits = field(default_factory=dict)
    #: Writes new paths of pictures into the calibration, where it names each: old -> new, or None where one is gone.
    relist: Callable[[Path, dict[str, str | None]], None] = lambda _folder, _names: None
    #: Gives the camera cameras[1] another name, in the calibration; "": names are the layout's.
    rename: Callable[[Path, str], None] | None = None

    @property
    def films(self) -> bool:
        return not self.at.endswith(".png")

    def path(self, folder: Path, camera: str, t: int = 0) -> Path:
        return folder / self.at.format(c=camera, t=t, n=t + 1)


@cache
def world() -> World:
    return tiny_recordings.make_world(frames=FRAMES)


def in_json(name: str, change: Callable[[Any], Any]) -> Edit:
    def edit(folder: Path) -> None:
        data = json.loads((folder / name).read_text())
        change(data)
        (folder / name).write_text(json.dumps(data))

    return edit


def in_text(name: str, pattern: str, new: str | Callable[[re.Match[str]], str], count: int = 1) -> Edit:
    """What a pattern finds is replaced; "." stands for anything, lines too."""

    def edit(folder: Path) -> None:
        text, done = re.subn(pattern, new, (folder / name).read_text(), count=count, flags=re.DOTALL)
        assert done, f"{name}: {pattern}"
        (folder / name).write_text(text)

    return edit


def put(*place: Any, value: Any) -> Callable[[Any], None]:
    """Set a value of nested lists and objects."""

    def change(data: Any) -> None:
        for key in place[:-1]:
            data = data[key]
        data[place[-1]] = value

    return change


NO_KEYS = "the file has no keys"
NO_LENS = "the format knows no lens"
NO_MODEL = "the format does not name the lens model"
NAMED = "names are those of the layout"

# cameras.json ------------------------------------------------------------------------------------------------


def declared(films: bool) -> Reader:
    names = tuple(f"cam{c:02d}" for c in range(4))

    def write(folder: Path) -> None:
        shown, entries = world(), []
        for c, name in enumerate(names):
            if films:
                write_video(folder / f"{name}.mkv", shown.pictures[:, c], rate=RATE)
            else:
                write_frames(folder / name, shown.pictures[:, c], digits=6)
            entries.append(
                {
                    "id": name,
                    "split": "test" if c == 0 else "train",
                    "width": tiny_recordings.SIZE[0],
                    "height": tiny_recordings.SIZE[1],
                    "K": shown.Ks[c].tolist(),
                    "w2c": shown.poses[c].tolist(),
                    "frames": f"{name}.mkv" if films else f"{name}/%06d.png",
                }
            )
        data = {"schema": "opencv-multiview-1", "cameras": entries}
        (folder / "cameras.json").write_text(json.dumps(data if films else data | {"frames": FRAMES, "fps": RATE}))
        if not films:
            (folder / "END").touch()

    def relist(folder: Path, names: dict[str, str | None]) -> None:
        """Patterns, not names: the first new name of each camera says the pattern."""

        def change(data: Any) -> None:
            for entry in data["cameras"]:
                own = [new for old, new in names.items() if new and old.startswith(f"{entry['id']}/")]
                if own:
                    entry["frames"] = re.sub(r"(\d+)(\.\w+)$", lambda m: f"{conversion(m[1])}{m[2]}", min(own, key=len))
            data["frames"] -= sum(new is None for new in names.values()) // len(data["cameras"])

        in_json("cameras.json", change)(folder)

    def rename(folder: Path, new: str) -> None:
        in_text("cameras.json", "cam01", new, 0)(folder)

    edits: Edits = {
        "unknown": in_json("cameras.json", put("zzz", value=1)),
        "refused": in_json("cameras.json", put("cameras", 1, "k1", value=0.1)),
        "nan": in_json("cameras.json", put("cameras", 1, "w2c", 0, 3, value=float("nan"))),
        "turn": in_json("cameras.json", put("cameras", 1, "w2c", 0, 0, value=5.0)),
        "pose": "what it does not name is not meant",
        "fisheye": in_json(
            "cameras.json", lambda data: data["cameras"][1].update(distortion=list(FISHEYE), fisheye=True)
        ),
        "lens": in_json("cameras.json", put("cameras", 1, "camera_model", value="EUCM")),
    }
    at = "{c}.mkv" if films else "{c}/{t:06d}.png"
    return Reader(write, "", names, at, "cameras.json", edits, relist, rename)


def conversion(number: str) -> str:
    """%06d for 000012, %d for 12."""
    return f"%0{len(number)}d" if number.startswith("0") else "%d"


#: k1 to k4 of the fisheye that a calibration is made to state.
FISHEYE = (0.02, -0.004, 0.001, 0.0)

# LLFF --------------------------------------------------------------------------------------------------------


def rows(change: Callable[[np.ndarray], np.ndarray]) -> Edit:
    return lambda folder: np.save(folder / "poses_bounds.npy", change(np.load(folder / "poses_bounds.npy")))


def cell(column: int, value: float) -> Edit:
    def change(data: np.ndarray) -> np.ndarray:
        data[1, column] = value
        return data

    return rows(change)


def llff(scheme: str, style: str, at: str) -> Reader:
    cam = "cam_{}" if scheme == "meetroom" else "cam{:02d}"

    def write(folder: Path) -> None:
        shutil.rmtree(folder)
        if scheme == "meetroom":
            tiny_recordings.write_meetroom(folder, world())
        else:
            tiny_recordings.write_n3dv(folder, world(), style=style)
        for path in folder.glob("*.mp4"):
            write_video(path, world().pictures[:, int(path.stem.lstrip("cam_"))], rate=RATE)

    edits: Edits = {
        "unknown": NO_KEYS,
        "refused": NO_KEYS,
        "nan": cell(3, np.nan),
        "turn": cell(0, 5.0),
        "pose": rows(lambda data: data[:3]),
        "fisheye": NO_LENS,
        "lens": NO_LENS,
    }
    return Reader(write, scheme, tuple(cam.format(c) for c in range(4)), at, "poses_bounds.npy", edits)


# EasyMocap ---------------------------------------------------------------------------------------------------


def easymocap(films: bool) -> Reader:
    names = tuple(f"{c:02d}" for c in range(4))

    def write(folder: Path) -> None:
        tiny_recordings.write_enerf(folder, world())
        width, height = tiny_recordings.SIZE
        sizes = "".join(f"W_{name}: {width}\nH_{name}: {height}\n" for name in names)
        (folder / "intri.yml").write_text((folder / "intri.yml").read_text() + sizes)
        if films:
            shutil.rmtree(folder / "images")
            for c, name in enumerate(names):
                write_video(folder / "videos" / f"{name}.mp4", world().pictures[:, c], rate=RATE)

    def rename(folder: Path, new: str) -> None:
        for file in ("intri.yml", "extri.yml"):
            in_text(file, r'_01:|"01"', lambda m: m[0].replace("01", new), 0)(folder)

    block = r"\S*_03: !!opencv-matrix.*?\]\n"
    edits: Edits = {
        "unknown": in_text("intri.yml", r"\Z", "zzz: 1\n"),
        "refused": in_text("intri.yml", r"\Z", "xi_01: 1\n"),
        "nan": in_text("extri.yml", r"(T_01:[^\[]*\[)[^,]*", r"\1.nan"),
        "turn": in_text("extri.yml", r"(Rot_01:[^\[]*\[)[^,]*", r"\g<1>5.0"),
        "pose": in_text("extri.yml", f"(?:{block})+", ""),
        "fisheye": NO_MODEL,
        "lens": in_text("intri.yml", r"\Z", "model_01: omni\n"),
    }
    at = "videos/{c}.mp4" if films else "images/{c}/{t:06d}.png"
    return Reader(write, "enerf", names, at, "intri.yml", edits, rename=rename)


# Panoptic ----------------------------------------------------------------------------------------------------


def panoptic() -> Reader:
    def relist(folder: Path, names: dict[str, str | None]) -> None:
        def change(data: Any) -> None:
            news = [[names.get(f"ims/{name}", f"ims/{name}") for name in row] for row in data["fn"]]
            kept = [t for t, row in enumerate(news) if None not in row]
            data["fn"] = [[str(name).removeprefix("ims/") for name in news[t]] for t in kept]
            for key in ("k", "w2c", "cam_id"):
                data[key] = [data[key][t] for t in kept]

        for file in ("train_meta.json", "test_meta.json"):
            in_json(file, change)(folder)

    def without(data: Any) -> None:
        for key in ("k", "w2c", "fn", "cam_id"):
            data[key] = [row[:-1] for row in data[key]]

    def at_all_times(*place: Any, value: Any) -> Callable[[Any], None]:
        def change(data: Any) -> None:
            for t in range(FRAMES):
                put("w2c", t, *place, value=value)(data)

        return change

    edits: Edits = {
        "unknown": in_json("train_meta.json", put("zzz", value=1)),
        "refused": in_json("train_meta.json", put("dist", value=[0.1])),
        "nan": in_json("train_meta.json", at_all_times(0, 0, 3, value=float("nan"))),
        "turn": in_json("train_meta.json", at_all_times(0, 0, 0, value=5.0)),
        "pose": in_json("train_meta.json", without),
        "fisheye": in_json("train_meta.json", put("fisheye", value=True)),
        "lens": in_json("train_meta.json", put("distCoef", value=[0.1])),
    }
    at = "ims/{c}/{t:06d}.png"
    return Reader(
        lambda folder: tiny_recordings.write_panoptic(folder, world()) and None,
        "panoptic",
        ("0", "1", "2", "3"),
        at,
        "train_meta.json",
        edits,
        relist,
    )


# COLMAP ------------------------------------------------------------------------------------------------------


def colmap(films: bool) -> Reader:
    def write(folder: Path) -> None:
        tiny_recordings.write_colmap(folder, world(), binary=False, frames="videos" if films else "folders")
        for path in folder.glob("videos/*.mp4"):
            write_video(path, world().pictures[:, int(path.stem[3:])], rate=RATE)

    cameras, images = "sparse/0/cameras.txt", "sparse/0/images.txt"
    bent = " ".join(map(str, FISHEYE))
    edits: Edits = {
        "unknown": NO_KEYS,
        "refused": NO_KEYS,
        "nan": in_text(images, r"(\n2 \S+ \S+ \S+ \S+ )\S+", r"\1nan"),
        "turn": in_text(images, r"(\n2 )\S+", r"\g<1>5.0"),
        "pose": in_text(images, r"\n4 [^\n]*\n[^\n]*", ""),
        "fisheye": in_text(cameras, r"\n2 PINHOLE ([^\n]*)", rf"\n2 OPENCV_FISHEYE \1 {bent}"),
        "lens": in_text(cameras, r"\n2 PINHOLE ([^\n]*)", r"\n2 EUCM \1 0.5 1.0"),
    }

    def rename(folder: Path, new: str) -> None:
        in_text(images, "cam01", new, 0)(folder)

    at = "videos/{c}.mp4" if films else "images/{c}/{t:04d}.png"
    return Reader(write, "colmap", tuple(f"cam{c:02d}" for c in range(4)), at, cameras, edits, rename=rename)


# nerfstudio --------------------------------------------------------------------------------------------------


def nerfstudio(style: str) -> Reader:
    """Of folders, of timed pictures, of films; or timed pictures in a file per split, as Blender's exporters do."""
    file = "transforms_train.json" if style == "splits" else "transforms.json"
    names = tuple(f"cam{c}" for c in range(4))

    def write(folder: Path) -> None:
        shutil.rmtree(folder)
        tiny_recordings.write_nerfstudio(folder, world(), style="timed" if style == "splits" else style)
        for path in folder.glob("*.mp4"):
            write_video(path, world().pictures[:, int(path.stem[3:])], rate=RATE)
        if style == "splits":
            data = json.loads((folder / "transforms.json").read_text())
            (folder / "transforms.json").unlink()
            del data["test_filenames"]
            for split in ("train", "test"):
                frames = [one for one in data["frames"] if ("cam0" in one["file_path"]) == (split == "test")]
                (folder / f"transforms_{split}.json").write_text(json.dumps(data | {"frames": frames}))

    def of(camera: str, change: Callable[[Any], Any]) -> Edit:
        """In all entries of a camera."""
        return in_json(file, lambda data: [change(e) for e in data["frames"] if camera in e["file_path"]])

    def without(data: Any) -> None:
        data["frames"] = [entry for entry in data["frames"] if "cam3" not in entry["file_path"]]

    def relist(folder: Path, names: dict[str, str | None]) -> None:
        def change(data: Any) -> None:
            for key in ("train_filenames", "test_filenames"):
                if key in data:
                    data[key] = [new for name in data[key] if (new := names.get(name, name))]
            for entry in data["frames"]:
                entry["file_path"] = names.get(entry["file_path"], entry["file_path"])
            data["frames"] = [entry for entry in data["frames"] if entry["file_path"]]

        for path in folder.glob("transforms*.json"):
            in_json(path.name, change)(folder)

    def rename(folder: Path, new: str) -> None:
        in_text(file, "cam1", new, 0)(folder)

    bent = {f"k{i + 1}": value for i, value in enumerate(FISHEYE)}
    edits: Edits = {
        "unknown": in_json(file, put("zzz", value=1)),
        "refused": in_json(file, put("skew", value=0.1)),
        "nan": of("cam1", put("transform_matrix", 0, 3, value=float("nan"))),
        "turn": of("cam1", put("transform_matrix", 0, 0, value=5.0)),
        "pose": in_json(file, without),
        "fisheye": of("cam1", lambda entry: entry.update(is_fisheye=True, **bent)),
        "lens": of("cam1", put("camera_model", value="EQUIRECTANGULAR")),
    }
    at = "{c}.mp4" if style == "videos" else "images/{c}/{t:04d}.png"
    timed = style in ("timed", "splits")
    return Reader(
        write, "nerfstudio", names, at, file, edits, relist if timed else lambda _folder, _names: None, rename
    )


# calibrations of other programs ------------------------------------------------------------------------------


@cache
def noise() -> np.ndarray:
    """[T, C, H, W, 3] uint8."""
    return np.random.default_rng(0).integers(0, 255, (FRAMES, len(NAMES), HEIGHT, WIDTH, 3)).astype(np.uint8)


def calibrated(name: str, file: str, edits: Edits, rename: Callable[[Path, str], None] | None, films: bool) -> Reader:
    def write(folder: Path) -> None:
        for c, camera in enumerate(NAMES):
            if films:
                write_video(folder / f"{camera}.mp4", noise()[:, c], rate=RATE)
            else:
                write_frames(folder / camera, noise()[:, c])
        FORMATS[name][0](folder)

    at = "{c}.mp4" if films else "{c}/{t:04d}.png"
    return Reader(write, "", NAMES, at, file, edits, rename=rename)


def rigs() -> dict[str, Reader]:
    toml, xml = "calibration/rig.toml", "cameras.xml"

    def named(file: str) -> Callable[[Path, str], None]:
        return lambda folder, new: in_text(file, r'(["\n])cam_1(["\.])', rf"\g<1>{new}\2")(folder)

    def file_named(suffix: str) -> Callable[[Path, str], None]:
        return lambda folder, new: (folder / f"cam_1{suffix}").rename(folder / f"{new}{suffix}") and None

    qualisys: Edits = {
        "unknown": in_text("Calib.qca.txt", "focalLengthU=", 'zzz="1" focalLengthU='),
        "refused": in_text("Calib.qca.txt", "focalLengthU=", 'skew="1" focalLengthU='),
        "nan": in_text("Calib.qca.txt", r' x="[^"]*"', ' x="nan"'),
        "turn": in_text("Calib.qca.txt", 'r11="[^"]*"', 'r11="5"'),
        "pose": in_text("Calib.qca.txt", 'active="1" serial="cam_2"', 'active="0" serial="cam_2"'),
        "fisheye": NO_MODEL,
        "lens": in_text("Calib.qca.txt", "focalLengthU=", 'radialDistortion4="0.1" focalLengthU='),
    }
    shared: Edits = {
        "unknown": in_text(toml, "size =", "zzz = 1\nsize ="),
        "refused": in_text(toml, "size =", "skew = 1\nsize ="),
        "nan": in_text(toml, r"(translation = \[)[^,]*", r"\1nan"),
        "fisheye": in_text(toml, r"distortions = [^\n]*", f"fisheye = true\ndistortions = {list(FISHEYE)}"),
        "lens": in_text(toml, "size =", 'model = "omni"\nsize ='),
    }
    anipose = {**shared, "turn": "every vector is a rotation", "pose": in_text(toml, r"\[cam_2\].*", "")}
    caliscope = {
        **shared,
        "turn": in_text(toml, r"(rotation = \[\[)[^,]*", r"\g<1>5.0"),
        "pose": in_text(toml, r"\[cameras.2\].*", ""),
    }
    opencv: Edits = {
        "unknown": in_text("cam_0.yml", r"\Z", "zzz: 1\n"),
        "refused": in_text("cam_0.yml", r"\Z", "xi: 1\n"),
        "nan": in_text("cam_0.yml", r"(\nT:[^\[]*\[ )[^,]*", r"\1.Nan"),
        "turn": in_text("cam_0.yml", r"(\nR:[^\[]*\[ )[^,]*", r"\g<1>5.0"),
        "pose": lambda folder: (folder / "cam_2.yml").unlink(),
        "fisheye": in_text(
            "cam_0.yml",
            r"distortion_coefficients: .*?\]",
            "model: fisheye\ndistortion_coefficients: !!opencv-matrix\n   rows: 4\n   cols: 1\n   dt: d\n"
            f"   data: {list(FISHEYE)}",
        ),
        "lens": in_text("cam_0.yml", r"\Z", "model: omni\n"),
    }
    metashape: Edits = {
        "unknown": in_text(xml, "<k1>", "<zzz>1</zzz><k1>"),
        "refused": in_text(xml, "<k1>", "<p3>0.1</p3><k1>"),
        "nan": in_text(xml, r"<transform>\S+", "<transform>nan"),
        "turn": in_text(xml, r"<transform>\S+", "<transform>5.0"),
        "pose": in_text(xml, r'(label="cam_2.png">)<transform>.*?</transform>', r"\1"),
        "fisheye": in_text(xml, 'label="unknown" type="frame"', 'label="unknown" type="fisheye"'),
        "lens": in_text(xml, 'label="unknown" type="frame"', 'label="unknown" type="spherical"'),
    }
    xmp: Edits = {
        "unknown": in_text("cam_0.xmp", "xcr:DistortionModel", 'xcr:zzz="1" xcr:DistortionModel'),
        "refused": in_text("cam_0.xmp", "xcr:DistortionModel", 'xcr:Skew="1" xcr:DistortionModel'),
        "nan": in_text("cam_0.xmp", r"<xcr:Position>\S+", "<xcr:Position>nan"),
        "turn": in_text("cam_0.xmp", r"<xcr:Rotation>\S+", "<xcr:Rotation>5.0"),
        "pose": lambda folder: (folder / "cam_2.xmp").unlink(),
        "fisheye": in_text("cam_0.xmp", "brown3t2", "fisheye"),
        "lens": in_text("cam_0.xmp", "brown3t2", "division"),
    }
    table: Edits = {
        "unknown": in_text("export.csv", r"\A([^\n]*)\n([^\n]*)\n([^\n]*)\n([^\n]*)", r"\1,zzz\n\2,1\n\3,1\n\4,1"),
        "refused": in_text("export.csv", r"\A([^\n]*)\n([^\n]*)\n([^\n]*)\n([^\n]*)", r"\1,skew\n\2,1\n\3,1\n\4,1"),
        "nan": in_text("export.csv", r"(\ncam_0.png,)[^,]*", r"\1nan"),
        "turn": "three angles are always a rotation",
        "pose": in_text("export.csv", r"\ncam_2[^\n]*", ""),
        "fisheye": NO_MODEL,
        "lens": NO_MODEL,
    }
    return {
        "Qualisys": calibrated("qualisys", "Calib.qca.txt", qualisys, named("Calib.qca.txt"), False),
        "Anipose, Pose2Sim": calibrated("anipose", toml, anipose, named(toml), False),
        "Caliscope": calibrated("caliscope", toml, caliscope, None, False),
        "Caliscope, videos": calibrated("caliscope", toml, caliscope, None, True),
        "OpenCV": calibrated("opencv", "cam_0.yml", opencv, file_named(".yml"), False),
        "Metashape": calibrated("metashape", xml, metashape, named(xml), False),
        "RealityCapture, XMP": calibrated("realitycapture-xmp", "cam_0.xmp", xmp, file_named(".xmp"), False),
        "RealityCapture, CSV": calibrated("realitycapture-csv", "export.csv", table, named("export.csv"), False),
    }


NO_CALIBRATION = "there is no calibration"


def raw(films: bool) -> Reader:
    """Without a calibration: what ``scene prepare`` alone takes."""
    edits: Edits = dict.fromkeys(("unknown", "refused", "nan", "turn", "pose", "fisheye", "lens"), NO_CALIBRATION)
    base = calibrated("opencv", "", edits, lambda _folder, _new: None, films)

    def write(folder: Path) -> None:
        base.write(folder)
        for path in folder.glob("*.yml"):
            path.unlink()

    return Reader(write, "raw", NAMES, base.at, "", edits, rename=base.rename)


READERS: dict[str, Reader] = {
    "cameras.json": declared(films=False),
    "cameras.json, videos": declared(films=True),
    "N3DV, videos": llff("n3dv", "videos", "{c}.mp4"),
    "N3DV, images/": llff("n3dv", "images", "{c}/images/{t:04d}.png"),
    "N3DV, folders": llff("n3dv", "folders", "{c}/{t:04d}.png"),
    "N3DV, instants": llff("n3dv", "instants", "frame{n:06d}/{c}.png"),
    "Meet Room": llff("meetroom", "videos", "{c}.mp4"),
    "EasyMocap": easymocap(films=False),
    "EasyMocap, videos": easymocap(films=True),
    "Panoptic": panoptic(),
    "COLMAP": colmap(films=False),
    "COLMAP, videos": colmap(films=True),
    "nerfstudio, folders": nerfstudio("folders"),
    "nerfstudio, times": nerfstudio("timed"),
    "nerfstudio, videos": nerfstudio("videos"),
    "nerfstudio, a file per split": nerfstudio("splits"),
    **rigs(),
    "no calibration": raw(films=False),
    "no calibration, videos": raw(films=True),
}
