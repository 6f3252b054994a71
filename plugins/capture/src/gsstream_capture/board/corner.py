"""Corners of a board to hundredths of a pixel, by comparing a picture with what the whole board looks like there.

OpenCV looks for a corner in a window, in which the markers beside it pull where the board is tilted or far away: of
corners with blur and noise one in fifteen was more than 0.15 pixels off, and those decide how far off a rig is. Here
the board that is known, markers included, is drawn around each corner and moved until picture and drawing agree
(Lucas and Kanade 1981, with the brightness and the contrast of each window).
"""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np

from gsstream.core.shapes import FloatArray

#: Half of the window around a corner, as a share of a square, and in pixels. A larger one sees more of the markers,
#: which prints of other programs have up to a hundredth of a square beside their place.
WINDOW, LEAST, MOST = 0.3, 3, 24
#: Samples a pixel along each axis; blur of a usual lens and sensor in pixels, which matters little.
SAMPLES, BLUR = 4, 0.7
#: Steps that are made at most, how small the last one is, and how far a corner may move, pixels.
STEPS, LAST, FARTHEST = 6, 1e-3, 3.0
#: Sides of the drawing's squares in pixels, of which the one is taken at which the markers' cells come out whole.
FINE = range(48, 129)


class Drawn:
    """A board as it looks, drawn once, of OpenCV's board."""

    def __init__(self, made: Any) -> None:
        cells = made.getDictionary().markerSize + 2
        marker_share = made.getMarkerLength() / made.getSquareLength()

        def uneven(fine: int) -> float:
            marker = fine * marker_share
            return float(sum(abs(side - round(side)) for side in (marker / cells, (fine - marker) / 2)))

        self._square = made.getSquareLength()
        fine = min(FINE, key=uneven)
        columns, rows = made.getChessboardSize()
        picture = made.generateImage((columns * fine, rows * fine), marginSize=0)
        self._picture = cv2.copyMakeBorder(picture, fine, fine, fine, fine, cv2.BORDER_CONSTANT, value=255)
        step, first = self._square / fine, self._square * (0.5 / fine - 1)
        #: From indices of the drawing to places on the board.
        self._placed = np.array([[step, 0, first], [0, step, first], [0, 0, 1]])

    def refined(self, grey: Any, points: FloatArray, places: FloatArray) -> tuple[FloatArray, Any]:
        """Return where corners are, and which of them are seen as they should be.

        Arguments:
            grey: [H, W] uint8.
            points: [n, 2] of the corners on the board, in its unit.
            places: [n, 2] where they were found, pixels from the corner of the picture.
        """
        seen, _ = cv2.findHomography(points, places, cv2.RANSAC, 2.0)
        out, good = places.copy(), np.zeros(len(places), bool)
        for i in range(len(places) if seen is not None else 0):
            moved = self._moved(grey, seen, points[i], places[i])
            good[i] = moved is not None
            out[i] = places[i] if moved is None else moved
        return out, good

    def _moved(self, grey: Any, seen: Any, point: FloatArray, place: FloatArray) -> FloatArray | None:
        projected = seen @ np.array([*point, 1.0])
        there = projected[:2] / projected[2]
        slope = (seen[:2, :2] - np.outer(there, seen[2, :2])) / projected[2] * self._square
        half = np.clip(np.ceil(WINDOW * np.abs(slope).sum(1)), LEAST, MOST).astype(int)
        first, size = np.floor(place).astype(int) - half, 2 * half + 1
        if (first < 0).any() or (first + size > grey.shape[::-1]).any():
            return None
        window = grey[first[1] : first[1] + size[1], first[0] : first[0] + size[0]].astype(np.float64)
        at = place.copy()
        for _ in range(STEPS):
            shift = np.array([[1, 0, at[0] - there[0] - first[0]], [0, 1, at[1] - there[1] - first[1]], [0, 0, 1]])
            drawn = self._window(shift @ seen, size)
            down, across = np.gradient(drawn)
            rows = np.stack([across, down, drawn, np.ones_like(drawn)], -1).reshape(-1, 4)
            found = np.linalg.lstsq(rows, window.ravel(), rcond=None)[0]
            if found[2] <= 0:
                return None
            step = np.clip(-found[:2] / found[2], -1.0, 1.0)
            at = at + step
            if np.abs(at - place).max() > FARTHEST:
                return None
            if np.abs(step).max() < LAST:
                break
        return at

    def _window(self, seen: Any, size: Any) -> FloatArray:
        """What a window of ``size`` shows of the board; OpenCV counts from the centre of the first pixel."""
        finer = np.array([[SAMPLES, 0, -0.5], [0, SAMPLES, -0.5], [0, 0, 1.0]])
        whole = (int(size[0]), int(size[1]))
        many = (whole[0] * SAMPLES, whole[1] * SAMPLES)
        drawn = cv2.warpPerspective(self._picture, finer @ seen @ self._placed, many, borderValue=255)
        blurred = cv2.GaussianBlur(drawn.astype(np.float32), (0, 0), BLUR * SAMPLES)
        return np.asarray(cv2.resize(blurred, whole, interpolation=cv2.INTER_AREA), np.float64)
