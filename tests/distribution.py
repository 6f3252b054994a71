"""What an installer leaves of a distribution: the metadata by which its entry points are found."""

from __future__ import annotations

from pathlib import Path


def write_metadata(site: Path, name: str, version: str, entry_points: str) -> None:
    """Declare the distribution ``name`` in the folder ``site``; its modules lie where ``entry_points`` says."""
    info = site / f"{name.replace('-', '_')}-{version}.dist-info"
    info.mkdir(parents=True)
    (info / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {name}\nVersion: {version}\n")
    (info / "entry_points.txt").write_text(entry_points)
