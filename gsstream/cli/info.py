"""``gsstream info``: what a stream holds and what it costs."""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated

import typer

from gsstream.cli.listing import plural, printable, table
from gsstream.cli.streams import Stream, progress_on, stream_file

if TYPE_CHECKING:
    from gsstream.evaluation.stream_stats import StreamStats
    from gsstream.player.playback import Playback


def info(
    stream: Stream,
    as_json: Annotated[bool, typer.Option("--json", help="Everything measured, packet by packet, as JSON.")] = False,
) -> None:
    """Say what a stream holds: method, cameras, packets and their sizes.

    Each size is printed beside the least that it could be.
    """
    file = stream_file(stream)
    from gsstream.evaluation.stream_stats import stream_stats
    from gsstream.player.playback import Playback

    with Playback(file) as playback:
        if not as_json:
            typer.echo(f"{file}: {_describe(playback)}")
        if playback.reader.damage is not None:
            raise playback.reader.damage
    stats = stream_stats(file, progress=progress_on("packet"))
    typer.echo(stats.to_json() if as_json else _costs(stats))


def _describe(playback: Playback) -> str:
    meta, reader = playback.meta, playback.reader
    frames = playback.frames
    size = f"{meta.train.width} x {meta.train.height} pixels"
    rows = [
        ("method", f"{meta.title} (recipe {meta.recipe_hash})"),
        ("recording", f"{meta.source} ({meta.extra.get('source_uri', 'unknown')})"),
        ("cameras", f"{len(meta.train)} train, {len(meta.test)} test, {size}, {meta.fps:g} frames/s"),
        ("Gaussians", f"{len(playback.state_at(frames[0]))} in frame {frames[0]}"),
        ("written by", ", ".join(f"{name} {version}" for name, version in sorted(meta.plugins.items()))),
    ]
    if reader.unfinished is not None:
        rows.append(("unfinished", f"{reader.unfinished.size} bytes from byte {reader.unfinished.offset}"))
    lines = [plural(len(frames), "frame"), *(f"  {key:<11}{printable(value)}" for key, value in rows), ""]
    sizes: dict[str, list[int]] = {}
    for entry in reader.frames:
        sizes.setdefault(entry.kind.name.lower(), []).append(entry.size)
    packets = [(kind, str(len(n)), f"{sum(n)}", f"{sum(n) / len(n):.0f}", f"{max(n)}") for kind, n in sizes.items()]
    return "\n".join(lines) + table(("PACKETS", "NUMBER", "BYTES", "MEAN", "LARGEST"), packets, indent="  ")


def _costs(stats: StreamStats) -> str:
    keys, deltas = stats.sections("key"), stats.sections("delta", "empty")
    number = max(len(stats.of("delta", "empty")), 1)
    rows = [
        (name, str(keys.get(name, 0)), f"{deltas.get(name, 0) / number:.1f}")
        for name in sorted({*keys, *deltas}, key=lambda n: -deltas.get(n, 0))
    ]
    found = stats.summary()
    lines = ["", table(("SECTION", "KEY BYTES", "BYTES/FRAME AFTER"), rows, indent="  "), ""]
    lines += [f"  {label:<18}{text}" for label, text in _lines(found) if text]
    return "\n".join(lines)


def _lines(found: dict[str, float | None]) -> list[tuple[str, str]]:
    def of(text: str, *names: str) -> str:
        """The text with these numbers; empty when one was not measured."""
        values = [found[name] for name in names]
        return "" if None in values else text.format(*values)

    return [
        ("key packet", of("1/{:.1f} of its attributes as float32", "key_raw_over_coded")),
        ("rate", of("{:.2f} KB/frame after frame 0, {:.2f} KB/frame with it", "kb_per_frame", "kb_amortised")),
        ("", of("{:.2f} Mbit/s after frame 0 at {:g} frames/s", "mbit_per_second", "fps")),
        ("sent", of("{:.2%} of the Gaussians, mean of later frames", "sent_share")),
        (
            "paper's estimate",
            of("{:.2f} KB/frame after frame 0, {:.2f} with it", "paper_kb_per_frame", "paper_kb_with_frame_0"),
        ),
        (
            "coder",
            of(
                "deltas {:.3f} and keys {:.3f} times the entropy of their symbols",
                "delta_coder_over_entropy",
                "key_coder_over_entropy",
            ),
        ),
        ("", of("deltas {:.2f} times smaller than float16 and zstd-19", "float16_zstd_over_coded")),
        ("decoding", of("{:.2f} ms a delta (median; most {:.2f})", "delta_decode_ms_median", "delta_decode_ms_most")),
    ]
