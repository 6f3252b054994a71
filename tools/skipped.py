"""What frames that are skipped cost the frames after them: a recording of which only every n-th frame is encoded.

    python -m tools.skipped SOURCE [KEY=VALUE ...] [--method s2gs-edge] [--frames 25] [--every 1 2 4] [--name NAME]

Frame 0 is made once. Then the recording is encoded for each n, and frames between two that are encoded are skipped, as
a live run that is behind does (``watch:...?behind=drop``). Prints a JSON object a line: means over the frames that are
encoded and all test cameras. *Changed* pixels differ from the picture that the test camera showed when the last frame
was encoded.
"""

from __future__ import annotations

import argparse
import json
import time
from dataclasses import replace
from typing import Any

import numpy as np
import torch

from gsstream.core.frame import Frame
from gsstream.encode import Encoder, encoder_for, open_recording, recipe_for
from gsstream.evaluation.records import mean
from gsstream.metrics.moving import changed_mask
from gsstream.metrics.picture_quality import psnr


def shown(encoder: Encoder, frame: Frame) -> list[Any]:
    """Return the decoded picture [H, W, 3] of each camera of a frame."""
    assembly, cameras = encoder.assembly, encoder.with_near_plane(frame).cameras
    scene, ground = encoder.state.player.gaussians.map(torch.from_numpy), assembly.background
    pictures = [assembly.renderer.render(scene, cameras, view, ground).image for view in range(len(cameras))]
    return [np.clip(picture.numpy(), 0, 1) for picture in pictures]


def main(words: list[str] | None = None) -> None:
    """Read the command line and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("source")
    parser.add_argument("settings", nargs="*", metavar="KEY=VALUE")
    parser.add_argument("--method", default="s2gs-edge")
    parser.add_argument("--frames", type=int, default=25)
    parser.add_argument("--every", type=int, nargs="+", default=[1, 2, 4])
    parser.add_argument("--name", default=None, help="of the recording, in the rows")
    options = parser.parse_args(words)
    settings: dict[str, Any] = dict(text.split("=", 1) for text in options.settings)
    with open_recording(options.source, recipe_for(options.method, settings)) as source:
        encoder = encoder_for(options.method, source, settings=settings)
        encoder.encode(source.stored_frame(0))
        start, number = encoder.state, min(options.frames, source.info.num_frames)
        for every in options.every:
            encoder.state, last, rows = start, source.frame(0, "test"), list[dict[str, float]]()
            for index in range(1, number):
                frame = source.stored_frame(index)
                if index % every:
                    encoder.encode(replace(frame, epoch_scale=0.0))
                    continue
                begun = time.process_time()
                packet = encoder.encode(frame).packet
                spent, test = time.process_time() - begun, source.frame(index, "test")
                pairs = list(zip(shown(encoder, test), test.images, last.images, strict=True))
                rows.append(
                    {
                        "whole_dB": mean([psnr(image, truth) for image, truth, _ in pairs]),
                        "changed_dB": mean(
                            [psnr(image, truth, changed_mask(truth, before)) for image, truth, before in pairs]
                        ),
                        "kb": len(packet.data) / 1000,
                        "cpu_s": spent,
                    }
                )
                last = test
            means = {name: round(mean([row[name] for row in rows]), 2) for name in rows[0]}
            about = {"recording": options.name or options.source, "every": every, "encoded": len(rows)}
            print(json.dumps({**about, **means, "method": options.method}), flush=True)


if __name__ == "__main__":
    main()
