"""One stream and its live viewers: the file is read as it grows, and each viewer is sent one packet after the other."""

from __future__ import annotations

import asyncio
import json
import time
from typing import TYPE_CHECKING, Any

from gsstream.core.errors import PacketError
from gsstream.serve.cursor import Cursor
from gsstream.serve.follow import Follower, State

if TYPE_CHECKING:
    from starlette.websockets import WebSocket

#: Seconds between two looks at the file, and between two at who writes it.
LOOK, WRITER_POLL_SECONDS = 0.01, 0.5
#: Seconds between two answers to one viewer.
ANSWER = 0.2


class Hub:
    """Everything that viewers of one stream share. Lives on one event loop."""

    def __init__(self, follower: Follower, *, max_viewers: int, max_lag: int = 30) -> None:
        """Serve the stream of a follower."""
        self.follower, self.max_viewers, self.max_lag = follower, max_viewers, max_lag
        self.viewers: set[Cursor] = set()
        self.state = State("waiting")
        self._news = asyncio.Event()

    async def run(self) -> None:
        """Look at the file until this task is cancelled."""
        asked = 0.0
        while True:
            changed, now = self.follower.look(), time.monotonic()
            if changed or now > asked + WRITER_POLL_SECONDS:
                asked, before, self.state = now, self.state, self.follower.state()
                if changed or self.state != before:
                    news, self._news = self._news, asyncio.Event()
                    news.set()
            await asyncio.sleep(LOOK)

    async def watch(self, socket: WebSocket, after: tuple[int, bytes] | None) -> None:
        """Serve one viewer, whose connection is accepted, until it or the server ends it."""
        if len(self.viewers) >= self.max_viewers:
            await socket.close(1013, f"{self.max_viewers} viewers are watching already")
            return
        cursor = Cursor(self.follower, max_lag=self.max_lag, after=after)
        self.viewers.add(cursor)
        tasks = [asyncio.create_task(self._send(socket, cursor)), asyncio.create_task(_answer(socket))]
        try:
            done, _ = await asyncio.wait(tasks, return_when=asyncio.FIRST_COMPLETED)
            for task in done:
                _raise_unless_gone(task)
        finally:
            self.viewers.discard(cursor)
            for task in tasks:
                task.cancel()
            await asyncio.gather(*tasks, return_exceptions=True)

    async def drained(self, seconds: float) -> None:
        """Wait until every viewer has every packet, or the time is over."""
        end = time.monotonic() + seconds
        while time.monotonic() < end and any(not cursor.at_end for cursor in self.viewers):
            await asyncio.sleep(LOOK)

    async def _send(self, socket: WebSocket, cursor: Cursor) -> None:
        """Send packets and states for ever. The connection holds at most one packet that the viewer has not taken."""
        stream, sent_state, damage, generation = self.follower, None, None, None
        while True:
            news, entry = self._news, cursor.next()
            # While packets remain for this viewer, its state is "live", also when the encoder has ended meanwhile.
            damage = damage if entry is None else None
            state = damage or (self.state if entry is None else State("live"))
            if state != sent_state:
                sent_state = state
                await _tell(socket, state=state.name, detail=state.detail, newest=stream.newest)
            if entry is None:
                await news.wait()
                continue
            try:
                data = stream.read(entry)
                if cursor.generation != generation:
                    generation = cursor.generation
                    await socket.send_bytes(stream.header())
            except (PacketError, OSError) as error:
                cursor.refuse()
                damage = State("damaged", str(error))
                continue
            if cursor.generation != stream.generation:
                continue
            if entry.frame in stream.written:
                await _tell(socket, frame=entry.frame, written=stream.written[entry.frame], newest=stream.newest)
            await socket.send_bytes(data)


async def _answer(socket: WebSocket) -> None:
    """Tell a viewer the time when it asks, so that it can say how late its picture is. Ends with the connection."""
    while True:
        message = await socket.receive()
        if message["type"] == "websocket.disconnect":
            return
        try:
            asked = json.loads(message.get("text") or "")["ping"]
        except (ValueError, TypeError, KeyError, RecursionError):
            continue
        if isinstance(asked, int | float):
            await _tell(socket, pong=asked, now=time.time() * 1000)
        await asyncio.sleep(ANSWER)


async def _tell(socket: WebSocket, **facts: Any) -> None:
    await socket.send_text(json.dumps(facts))


def _raise_unless_gone(task: asyncio.Task[None]) -> None:
    """Raise the error that ended a task, unless its viewer left."""
    from starlette.websockets import WebSocketDisconnect

    error = task.exception()
    if error is not None and not isinstance(error, WebSocketDisconnect):
        raise error
