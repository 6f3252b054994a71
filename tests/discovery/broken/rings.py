"""Parts that fail in a ring of their own, and a healthy one beside them. Nothing heavy is imported here."""

from gsstream.spec import ComponentSpec, hookimpl

_PARTS = {
    "sound": ("gate", "Sound"),
    "needs-a-library": ("gate", "NeedsALibrary"),
    "unbuildable": ("gate", "Unbuildable"),
    "raises": ("confidence", "Raises"),
    "undefined": ("confidence", "Undefined"),
    "short": ("propagation", "Short"),
    "tripping": ("gate", "Tripping"),
    "taxing": ("regularizer", "Taxing"),
}


@hookimpl
def gsstream_components():
    return [
        ComponentSpec(
            kind=kind,
            name=name,
            summary="for the failure drill",
            target=f"gsstream_absent:{cls}" if name == "needs-a-library" else f"gsstream_rings.parts:{cls}",
        )
        for name, (kind, cls) in _PARTS.items()
    ]
