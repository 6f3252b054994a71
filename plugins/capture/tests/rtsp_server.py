"""An RTSP camera for tests, run by the system's Python: Debian's gir1.2-gst-rtsp-server-1.0 and python3-gst-1.0.

usage: rtsp_server.py PORT FPS EPOCH NAME=UNITS [NAME=UNITS ...]

UNITS holds access units of H.264 that were encoded ahead, each after its length (4 bytes, little end first): a busy
machine then only sends. Picture n of all cameras is sent at EPOCH + n / FPS, and shows n modulo the number of units.
Lines on stdin change what happens: "delay NAME MS", "off NAME", "on NAME", "garbage NAME COUNT", "units NAME FILE",
"jitter NAME MS", "lose NAME SHARE". With --clock SECONDS the sender's clock is off by so much; with --user and
--password it asks for them.
"""

import argparse
import random
import struct
import sys
import threading
import time

import gi

gi.require_version("Gst", "1.0")
gi.require_version("GstRtspServer", "1.0")
from gi.repository import GLib, Gst, GstRtspServer  # noqa: E402


def units_of(path):
    with open(path, "rb") as file:
        data = file.read()
    found, at = [], 0
    while at < len(data):
        (length,) = struct.unpack_from("<I", data, at)
        found.append(data[at + 4 : at + 4 + length])
        at += 4 + length
    return found


class State:
    def __init__(self, units):
        self.units, self.delay, self.off, self.garbage, self.jitter, self.lose = units, 0.0, False, 0, 0.0, 0.0
        self.source = None


class Factory(GstRtspServer.RTSPMediaFactory):
    def __init__(self, state, fps):
        super().__init__()
        self.state, self.fps = state, fps
        self.set_shared(True)
        self.set_latency(0)

    def do_create_element(self, url):
        return Gst.parse_launch(
            "( appsrc name=src is-live=true format=time "
            f"caps=video/x-h264,stream-format=byte-stream,alignment=au,framerate={int(self.fps)}/1 ! "
            "h264parse ! rtph264pay name=pay0 pt=96 config-interval=1 )"
        )

    def do_configure(self, media):
        source = media.get_element().get_by_name("src")
        self.state.source = source

        def gone(_):
            if self.state.source is source:
                self.state.source = None

        media.connect("unprepared", gone)


def push(state, epoch, fps):
    draw = random.Random(1)
    number = int((time.time() - epoch) * fps)
    while True:
        number += 1
        at = epoch + number / fps + state.delay + draw.uniform(0, state.jitter)
        time.sleep(max(0.0, at - time.time()))
        source, unit = state.source, state.units[number % len(state.units)]
        if time.time() - at > 0.5 / fps:
            continue  # stopped meanwhile: a camera does not send what it saw before
        if source is None or state.off or draw.random() < state.lose:
            continue
        if state.garbage > 0:
            state.garbage -= 1
            noise = bytes(draw.randrange(1, 256) for _ in range(len(unit) - 5))
            unit = unit[:5] + noise
        # Stamped with the time at which it was to be sent: a camera knows when it exposed, however busy it is.
        clock, base = source.get_clock(), source.get_base_time()
        if clock is None:
            continue
        buffer = Gst.Buffer.new_wrapped(unit)
        buffer.pts = max(0, clock.get_time() - base - int(1e9 * (time.time() - at)))
        source.emit("push-buffer", buffer)


def obey(states, loop):
    for line in sys.stdin:
        what, name, *rest = line.split()
        state = states[name]
        if what == "delay":
            state.delay = float(rest[0]) / 1000
        elif what == "jitter":
            state.jitter = float(rest[0]) / 1000
        elif what == "lose":
            state.lose = float(rest[0])
        elif what == "garbage":
            state.garbage = int(rest[0])
        elif what == "units":
            state.units = units_of(rest[0])
        else:
            state.off = what == "off"
    loop.quit()


def main():
    parser = argparse.ArgumentParser()
    parser.add_argument("port")
    parser.add_argument("fps", type=float)
    parser.add_argument("epoch", type=float)
    parser.add_argument("cameras", nargs="+")
    parser.add_argument("--user")
    parser.add_argument("--password")
    given = parser.parse_args()
    Gst.init(None)
    server = GstRtspServer.RTSPServer()
    server.set_address("127.0.0.1")
    server.set_service(given.port)
    if given.user:
        auth = GstRtspServer.RTSPAuth()
        token = GstRtspServer.RTSPToken()
        token.set_string("media.factory.role", "viewer")
        auth.add_basic(GstRtspServer.RTSPAuth.make_basic(given.user, given.password), token)
        server.set_auth(auth)
    states = {}
    for camera in given.cameras:
        name, _, path = camera.partition("=")
        states[name] = State(units_of(path))
        factory = Factory(states[name], given.fps)
        if given.user:
            permissions = GstRtspServer.RTSPPermissions()
            for right in ("media.factory.access", "media.factory.construct"):
                permissions.add_permission_for_role("viewer", right, True)
            factory.set_permissions(permissions)
        server.get_mount_points().add_factory(f"/{name}", factory)
    server.attach(None)
    loop = GLib.MainLoop()
    for state in states.values():
        threading.Thread(target=push, args=(state, given.epoch, given.fps), daemon=True).start()
    threading.Thread(target=obey, args=(states, loop), daemon=True).start()
    print("ready", server.get_bound_port(), flush=True)
    loop.run()


if __name__ == "__main__":
    main()
