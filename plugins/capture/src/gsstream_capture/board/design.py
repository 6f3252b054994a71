"""The board: which one it is, where its corners are, its page to print, and finding it in a picture."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from pydantic import BaseModel, ConfigDict, Field, ValidationError
from ruamel.yaml import YAML
from ruamel.yaml.error import YAMLError

from gsstream.core.errors import SourceError
from gsstream.core.shapes import FloatArray, IntArray
from gsstream_capture.board.corner import Drawn

#: Corners of a board that a picture must show.
FEWEST = 6
#: Pixels of the printed page for a millimetre (254 dots per inch).
DOTS = 10
_DICTIONARIES = tuple(name for name in dir(cv2.aruco) if name.startswith("DICT_"))


class Board(BaseModel):
    """A ChArUco board; an AprilTag board is one of another dictionary. Lengths in millimetres."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    columns: int = Field(default=7, ge=3, le=40, description="squares across")
    rows: int = Field(default=5, ge=3, le=40, description="squares down")
    square_mm: float = Field(default=56.0, gt=0, le=2000, description="side of a square, as measured on the print")
    marker_share: float = Field(default=0.75, gt=0.2, lt=1, description="side of a marker, as a share of a square")
    dictionary: str = Field(default="DICT_5X5_100", description="of the markers, by OpenCV's name")
    inverted: bool = Field(default=False, description="whether black and white are exchanged")
    glass: bool = Field(default=False, description="whether it is on glass and is read from behind, mirrored, too")
    legacy: bool = Field(default=False, description="whether it was made by OpenCV before 4.6")

    @property
    def points(self) -> FloatArray:
        """[K, 3] inner corners in metres: x across, y down, z into the board."""
        return np.asarray(self.made().getChessboardCorners(), np.float64)

    def made(self) -> Any:
        """Return OpenCV's board, in metres."""
        square = self.square_mm / 1000
        dictionary = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, self.dictionary))
        board = cv2.aruco.CharucoBoard((self.columns, self.rows), square, square * self.marker_share, dictionary)
        board.setLegacyPattern(self.legacy)
        return board


@dataclass(frozen=True, slots=True)
class Sighting:
    """Corners of the board in one picture: ``ids`` [n], ``places`` [n, 2] pixels from the corner of the picture."""

    ids: IntArray
    places: FloatArray


class Finder:
    """Finds a board in pictures."""

    def __init__(self, board: Board) -> None:
        parameters = cv2.aruco.DetectorParameters()
        parameters.cornerRefinementMethod = cv2.aruco.CORNER_REFINE_SUBPIX
        self._board, self._drawn = board, Drawn(board.made())
        self._detector = cv2.aruco.CharucoDetector(board.made(), cv2.aruco.CharucoParameters(), parameters)

    def find(self, picture: Any) -> Sighting | None:
        """Return the board's corners in [H, W] or [H, W, 3] uint8; None where too few are seen, or all on a line."""
        grey = cv2.cvtColor(picture, cv2.COLOR_BGR2GRAY) if picture.ndim == 3 else picture
        grey = 255 - grey if self._board.inverted else grey
        found = self._seen(grey)
        if found is None and self._board.glass and (mirrored := self._seen(np.ascontiguousarray(grey[:, ::-1]))):
            places = mirrored.places.copy()
            places[:, 0] = grey.shape[1] - places[:, 0]
            found = Sighting(mirrored.ids, places)
        return found

    def _seen(self, grey: Any) -> Sighting | None:
        corners, ids, _, _ = self._detector.detectBoard(grey)
        if ids is None or len(ids) < FEWEST:
            return None
        numbers = np.asarray(ids).ravel().astype(np.int64)
        # OpenCV counts from the centre of the first pixel, this project from its corner.
        near = np.asarray(corners, np.float64).reshape(-1, 2) + 0.5
        places, good = self._drawn.refined(grey, self._board.points[numbers, :2], near)
        if good.sum() < FEWEST:
            return None
        numbers, places = numbers[good], places[good]
        spread = np.linalg.svd(self._board.points[numbers, :2] - self._board.points[numbers, :2].mean(0))[1]
        if spread[1] < 0.5 * self._board.square_mm / 1000:
            return None
        return Sighting(numbers, places)


def read_board(path: Path) -> Board:
    """Read ``board.yaml``. Raises SourceError naming the key that is unknown or out of range."""
    try:
        data = YAML(typ="safe", pure=True).load(path.read_text(encoding="utf-8")) or {}
        board = Board.model_validate(data)
    except (OSError, UnicodeDecodeError, YAMLError) as error:
        raise SourceError(f"{path}: the board's file cannot be read: {error}") from error
    except ValidationError as error:
        first = error.errors()[0]
        key = ".".join(map(str, first["loc"]))
        raise SourceError(f"{path}: {key}: {first['msg'].lower()}; keys: {', '.join(Board.model_fields)}") from error
    if board.dictionary not in _DICTIONARIES:
        raise SourceError(f"{path}: dictionary: no {board.dictionary!r}; known: {', '.join(_DICTIONARIES)}")
    size = len(cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, board.dictionary)).bytesList)
    if size < board.columns * board.rows // 2:
        raise SourceError(f"{path}: {board.dictionary} has {size} markers, the board needs more; take a larger one")
    return board


def page(board: Board) -> Any:
    """Return the board as an image of 10 pixels a millimetre, on white, with a ruler of 100 mm below."""
    from PIL import Image, ImageDraw

    square = round(board.square_mm * DOTS)
    size = (board.columns * square, board.rows * square)
    drawn = board.made().generateImage(size, marginSize=0)
    margin, below = 8 * DOTS, 22 * DOTS
    sheet = Image.new("L", (size[0] + 2 * margin, size[1] + 2 * margin + below), 255)
    sheet.paste(Image.fromarray(255 - drawn if board.inverted else drawn), (margin, margin))
    draw, top = ImageDraw.Draw(sheet), size[1] + 2 * margin
    for millimetre in range(101):
        high = DOTS * (8 if millimetre % 10 == 0 else 5 if millimetre % 5 == 0 else 3)
        x = margin + millimetre * DOTS
        draw.line([(x, top), (x, top + high)], fill=0, width=2)
    message = (
        f"100 mm. Print at 100 %, glue it on something flat, measure a square: {board.square_mm:g} mm in board.yaml"
    )
    draw.text((margin, top + 10 * DOTS), message, fill=0, font_size=4 * DOTS)
    return sheet
