"""Look at a stream in a browser: viser serves the page (extra ``viewer``), on loopback unless asked otherwise."""

from __future__ import annotations

import importlib.util
import os
import threading
import warnings
from typing import TYPE_CHECKING, Any

import numpy as np

from gsstream.core.errors import InputError, OutputError
from gsstream.core.gaussians import SH0, Gaussians
from gsstream.core.needs import install_extra
from gsstream.core.shapes import FloatArray
from gsstream.player.playback import Playback
from gsstream.player.software import rotation_matrices

if TYPE_CHECKING:
    import viser

LOOPBACK = "127.0.0.1"


class Viewer:
    """A served stream: time slider, play and pause, start views at the recording's cameras. Close it when done.

    The browser gets positions, covariances, opacities and the colour seen from no direction in particular: viser draws
    no view-dependent colour. Pictures to be measured come from ``gsstream play``.
    """

    def __init__(self, stream: str | os.PathLike[str], *, host: str = LOOPBACK, port: int = 8080) -> None:
        """Serve a stream; :attr:`url` says where.

        Raises InputError without viser, SourceError or PacketError for a missing or damaged stream, OutputError when
        nothing can be served at this address.
        """
        if importlib.util.find_spec("viser") is None:
            raise InputError(f"viewing in the browser needs viser: {install_extra('viewer')}; or use gsstream play")
        import viser

        self.playback = Playback(stream)
        _, damage = self.playback.sound()
        if damage is not None:
            warnings.warn(f"{stream} is damaged, what is before is shown: {damage}", stacklevel=2)
        try:
            self.server = viser.ViserServer(host=host, port=port, label="gsstream", verbose=False)
        except OSError as error:
            self.playback.close()
            raise OutputError(f"cannot serve at {host}:{port}: {error.strerror or error}") from error
        # Events arrive on the server's threads, and a playback is one reader with one position.
        self._lock = threading.Lock()
        self._closed = threading.Event()
        self._shown: Gaussians[FloatArray] | None = None
        frames = self.playback.frames
        self._splats = self.server.scene.add_gaussian_splats("/scene", **splats(self.playback.state_at(frames[0])))
        last = max(frames[-1], frames[0] + 1)  # a slider needs two ends, also for one frame
        # viser's types say its value is read-only; its documentation and its code say that it can be set.
        self.slider: Any = self.server.gui.add_slider(
            "frame", min=frames[0], max=last, step=1, initial_value=frames[0], disabled=len(frames) == 1
        )
        self.playing = self.server.gui.add_checkbox("play", initial_value=False, disabled=len(frames) == 1)
        self.slider.on_update(lambda _event: self.show(int(self.slider.value)))
        self.server.on_client_connect(self._greet)
        self._clock = threading.Thread(target=self._run, name="gsstream-view", daemon=True)
        self._clock.start()

    def __enter__(self) -> Viewer:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    @property
    def url(self) -> str:
        """Where the page is."""
        return f"http://{self.server.get_host()}:{self.server.get_port()}"

    def show(self, frame: int) -> None:
        """Send a frame to everybody who looks; an unchanged scene is not sent again."""
        with self._lock:
            if self._closed.is_set() or frame not in self.playback.frames:
                return
            scene = self.playback.state_at(frame)
            if scene is not self._shown:
                self._splats.set_gaussians(**splats(scene))
                self._shown = scene

    def wait(self) -> None:
        """Wait until :meth:`close` or an interrupt."""
        while not self._closed.wait(0.5):
            pass

    def close(self) -> None:
        """Stop serving."""
        with self._lock:
            if self._closed.is_set():
                return
            self._closed.set()
        self._clock.join()
        self.server.stop()
        self.playback.close()

    def _run(self) -> None:
        frames = self.playback.frames
        while not self._closed.wait(1 / self.playback.meta.fps):
            if self.playing.value:
                following = int(self.slider.value) + 1
                # Setting the slider calls show() by its event.
                self.slider.value = following if following in frames else frames[0]

    def _greet(self, client: viser.ClientHandle) -> None:
        """A new visitor starts where the first test (else train) camera stood."""
        meta = self.playback.meta
        rig = meta.test if len(meta.test) else meta.train
        pose = np.linalg.inv(rig.viewmats[0])
        client.camera.position = pose[:3, 3]
        client.camera.look_at = pose[:3, 3] + pose[:3, 2]
        client.camera.up_direction = -pose[:3, 1]
        client.camera.fov = 2 * float(np.arctan(rig.height / (2 * rig.Ks[0, 1, 1])))


def splats(gaussians: Gaussians[FloatArray]) -> dict[str, Any]:
    """Return centres [N, 3], covariances [N, 3, 3], colours [N, 3] in [0, 1], opacities [N, 1] in (0, 1)."""
    axes = rotation_matrices(gaussians.quats) * np.exp(gaussians.scales)[:, None, :]
    return {
        "centers": gaussians.means,
        "covariances": axes @ axes.transpose(0, 2, 1),
        "rgbs": np.clip(0.5 + SH0 * gaussians.sh0[:, 0], 0, 1),
        "opacities": 1 / (1 + np.exp(-np.clip(gaussians.opacities, -80, 80)))[:, None],
    }
