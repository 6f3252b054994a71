"""What a prepared scene looks like: a page of Markdown and a picture of cameras and points."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from gsstream.core.frame import PointCloud
from gsstream.input.prepare.findings import Finding
from gsstream.input.prepare.prepare import Prepared

REPORT, PICTURE = "report.md", "scene.png"


def write_report(out: Path, made: Prepared, found: list[Finding], seconds: float) -> list[Path]:
    """Write both into the scene's folder; return their paths."""
    mapping = made.mapping
    lines = [
        f"# {out.name}", "",
        f"- cameras: {len(made.rig)} of {len(made.names)} placed, {len(made.test)} of them for testing only; "
        f"{'given' if made.known_poses else 'recovered'} poses",
        f"- pictures: {made.rig.width} x {made.rig.height}, {made.frames} frame{'s' if made.frames > 1 else ''}",
        *_points_told(made),
        f"- seconds: {seconds:.1f}", "",
        f"![cameras and points]({PICTURE})", "",
        "| camera | use | reprojection error, pixels | points | focal length |", "|---|---|---|---|---|",
    ]  # fmt: skip
    for i, name in enumerate(made.names):
        use = "left out" if name in made.left_out else "test" if name in made.test else "train"
        error = mapping.camera_error[i]
        shown = f"{error:.3f}" if np.isfinite(error) else "-"
        focal = "-" if name in made.left_out else f"{made.rig.Ks[made.rig.ids.index(name), 0, 0]:.1f}"
        lines.append(f"| {name} | {use} | {shown} | {mapping.camera_points[i]} | {focal} |")
    lines += ["", "## Checks", ""]
    lines += [f"- {finding.severity}: {finding.message}" for finding in found] or ["Nothing to remark."]
    (out / REPORT).write_text("\n".join(lines) + "\n", encoding="utf-8")
    _draw(out / PICTURE, made)
    return [out / REPORT, out / PICTURE]


def _points_told(made: Prepared) -> list[str]:
    if made.points is None or made.bounds is None:
        return [f"- points: none ({len(made.mapping.xyz)} found); how well the poses fit is not known"]
    errors = made.mapping.camera_error[np.isfinite(made.mapping.camera_error)]
    return [
        f"- mean reprojection error: {float(np.mean(made.mapping.error)):.3f} pixels over "
        f"{len(made.mapping.error)} points; cameras {errors.min():.3f} to {errors.max():.3f}",
        f"- points kept: {len(made.points)}; bounds {np.round(made.bounds, 3).tolist()}",
    ]


def _draw(path: Path, made: Prepared) -> None:
    """Two views along the rig's axes, and the errors of the cameras."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(15, 5), layout="constrained")
    FigureCanvasAgg(figure)
    up, across, ahead = _axes(made)
    points = made.points or PointCloud(np.zeros((0, 3)), np.zeros((0, 3), np.float32), "none")
    xyz = points.xyz - made.rig.centers.mean(0)
    centers, forward = made.rig.centers - made.rig.centers.mean(0), made.rig.viewmats[:, 2, :3]
    length = 0.2 * float(np.ptp(centers, axis=0).max() or 1.0)
    test = np.array([name in made.test for name in made.rig.ids])
    for number, (title, right, top) in enumerate((("from above", across, ahead), ("from the side", ahead, up))):
        plot = figure.add_subplot(1, 3, number + 1)
        plot.scatter(xyz @ right, xyz @ top, c=points.rgb, s=2, linewidths=0)
        for mask, color, label in ((~test, "tab:blue", "train"), (test, "tab:red", "test")):
            if mask.any():
                place, way = centers[mask], length * forward[mask]
                plot.quiver(
                    place @ right,
                    place @ top,
                    way @ right,
                    way @ top,
                    color=color,
                    label=label,
                    angles="xy",
                    scale_units="xy",
                    scale=1,
                    width=0.004,
                )
        flat = np.concatenate([xyz, centers]) @ np.stack([right, top]).T
        low, high = np.percentile(flat, [1, 99], axis=0)
        plot.set_xlim(min(low[0], (centers @ right).min()) - length, max(high[0], (centers @ right).max()) + length)
        plot.set_ylim(min(low[1], (centers @ top).min()) - length, max(high[1], (centers @ top).max()) + length)
        plot.set_aspect("equal")
        plot.set_title(f"{title}: cameras and points, scene units")
        if number == 0:
            plot.legend(loc="upper right")
    _draw_errors(figure.add_subplot(1, 3, 3), made)
    figure.savefig(path, dpi=100)


def _draw_errors(bars: Any, made: Prepared) -> None:
    """A bar per camera; a camera whose error is unknown says so (no bar would read as an error of zero)."""
    error = made.mapping.camera_error
    known = np.isfinite(error)
    colors = ["tab:red" if name in made.test else "tab:blue" for name in made.names]
    bars.barh(range(len(made.names)), np.where(known, error, 0), color=colors)
    for i in np.flatnonzero(~known):
        why = "left out" if made.names[i] in made.left_out else "not measured"
        bars.annotate(why, (0, i), (3, 0), textcoords="offset points", va="center", fontsize=7)
    bars.set_yticks(range(len(made.names)), made.names, fontsize=7)
    bars.invert_yaxis()
    bars.set_xlabel("mean reprojection error, pixels")
    bars.set_title("how well points fit the pictures")


def _axes(made: Prepared) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Up, across and ahead, unit vectors: the cameras' mean up, and their mean view made level."""
    up = -made.rig.viewmats[:, 1, :3].mean(0)
    up = up / np.linalg.norm(up)
    ahead = made.rig.viewmats[:, 2, :3].mean(0)
    if np.linalg.norm(ahead - up * (ahead @ up)) < 0.05:
        ahead = made.rig.viewmats[0, 2, :3]  # a ring of cameras has no mean direction
    ahead = ahead - up * (ahead @ up)
    ahead = ahead / np.linalg.norm(ahead)
    return up, np.cross(ahead, up), ahead
