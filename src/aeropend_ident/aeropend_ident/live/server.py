# SPDX-License-Identifier: Apache-2.0
"""The page of `watch`: files of the folder `page`, and a WebSocket on which samples and states go out.

Nothing comes in: what a browser sends is not read. The server runs in a thread of its own, on this machine only unless
told otherwise.
"""

from __future__ import annotations

import asyncio
import json
import math
import threading
from collections import deque
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
import tornado.httpserver
import tornado.web
import tornado.websocket

from aeropend_ident.live.companion_model import Residuals
from aeropend_ident.live.intake import Batch, Intake
from aeropend_ident.live.watcher import PARTED, Watcher
from aeropend_sim.errors import UserError
from aeropend_sim.model.parameters import SAMPLE_PERIOD

FILES = Path(__file__).parent / "page"

THINNED = 8
"""Samples of which the page gets one: 61 Hz (choice: more points than a trace of a minute has pixels)."""

SHOWN_S = 60.0
"""[s] Length of the traces."""

STATE_S = 0.5
"""[s] Least time between two states that are sent (choice)."""

VIEWERS = 50
"""Greatest number of viewers (choice: five times what the page is made for)."""

BEHIND = 1 << 20
"""Bytes that may wait for a viewer; a slower one misses samples (choice: a minute of samples)."""

HISTORY = 50
"""Verdicts that are kept (choice)."""

HEADERS = {
    "Content-Security-Policy": "default-src 'self'; connect-src 'self' ws: wss:; frame-ancestors 'none'",
    "X-Content-Type-Options": "nosniff",
    "Referrer-Policy": "no-referrer",
    "Cache-Control": "no-cache",
}


class _Files(tornado.web.StaticFileHandler):
    def set_extra_headers(self, _path: str) -> None:
        for name, value in HEADERS.items():
            self.set_header(name, value)


class _Viewer(tornado.websocket.WebSocketHandler):
    def initialize(self, page: Page) -> None:
        self._page = page

    def open(self, *_: str, **__: str) -> None:
        self.set_nodelay(True)
        self._page.join(self)

    def on_message(self, message: str | bytes) -> None:
        """Nothing that a viewer says is read."""

    def on_close(self) -> None:
        self._page.leave(self)


class Page:
    """Serves the page.

    Args:
        address: to listen on.
        port: to listen on; 0: any.
        model: name of the model, as it is shown.

    Attributes:
        url: of the page.
        reference: last reference heard.

    Raises:
        UserError: the address cannot be used.
    """

    def __init__(self, address: str, port: int, model: str) -> None:
        self.reference = math.nan
        self._hello = {"model": model, "seconds": SHOWN_S}
        self._viewers: set[_Viewer] = set()
        self._past: deque[list[Any]] = deque(maxlen=round(SHOWN_S / (SAMPLE_PERIOD * THINNED)))
        self._skip = 0
        self._history: deque[dict[str, Any]] = deque(maxlen=HISTORY)
        self._state = ""
        self._sent_at = -math.inf
        self._nodes: dict[str, dict[str, Any]] = {}
        self._loop = asyncio.new_event_loop()
        application = tornado.web.Application(
            [(r"/live", _Viewer, {"page": self}),
             (r"/(.*)", _Files, {"path": str(FILES), "default_filename": "index.html"})],
            websocket_ping_interval=20, websocket_max_message_size=1024)
        asyncio.set_event_loop(self._loop)
        self._server = tornado.httpserver.HTTPServer(application, max_body_size=1024)
        try:
            sockets = tornado.netutil.bind_sockets(port, address)
        except OSError as error:
            raise UserError(f"the page cannot be shown at {address}:{port}: {error.strerror}; give another page_port"
                            ) from error
        finally:
            asyncio.set_event_loop(None)
        shown = "127.0.0.1" if address in ("0.0.0.0", "") else address  # noqa: S104
        self.url = f"http://{shown}:{sockets[0].getsockname()[1]}"
        self._thread = threading.Thread(target=self._serve, args=(sockets,), name="page", daemon=True)
        self._thread.start()

    def _serve(self, sockets: Any) -> None:
        asyncio.set_event_loop(self._loop)
        self._server.add_sockets(sockets)
        self._loop.run_forever()

    def close(self) -> None:
        """End the server."""
        def end() -> None:
            self._server.stop()
            for viewer in list(self._viewers):
                viewer.close(1001)
            self._loop.call_later(0.05, self._loop.stop)

        self._loop.call_soon_threadsafe(end)
        self._thread.join(2.0)

    # ---- in the server's thread

    def join(self, viewer: _Viewer) -> None:
        """A viewer has come: it gets the last minute."""
        if len(self._viewers) >= VIEWERS:
            viewer.close(1013, "too many viewers")
            return
        self._viewers.add(viewer)
        _write(viewer, json.dumps({"hello": self._hello, "samples": list(self._past)}))
        if self._state:
            _write(viewer, self._state)

    def leave(self, viewer: _Viewer) -> None:
        """A viewer has gone."""
        self._viewers.discard(viewer)

    def _send(self, text: str) -> None:
        for viewer in list(self._viewers):
            stream = viewer.ws_connection.stream if viewer.ws_connection else None
            if stream is None or len(stream._write_buffer) > BEHIND:
                continue
            _write(viewer, text)

    def _take(self, rows: list[list[Any]]) -> None:
        self._past.extend(rows)
        if self._viewers:
            self._send(json.dumps({"samples": rows}))

    # ---- in the node's thread

    def samples(self, batch: Batch, residuals: Residuals) -> None:
        """Take samples, measured and of the model."""
        part = slice(self._skip, None, THINNED)
        n = len(batch.stamps)
        self._skip = (self._skip - n) % THINNED
        s, m = batch.samples, residuals.said
        columns = [s.theta, m.theta, s.omega, m.omega, s.i_a, m.i_a, s.v_a, m.v_a, s.duty]
        table = np.array([np.asarray(c)[part] for c in columns]).T
        stamps = (batch.stamps[part] * 1e-9).tolist()
        rows = [[round(t, 4), *(_number(x) for x in row), _number(self.reference)]
                for t, row in zip(stamps, table.tolist(), strict=True)]
        if rows:
            self._loop.call_soon_threadsafe(self._take, rows)

    def heard(self, name: str, level: int, message: str, values: Mapping[str, str]) -> None:
        """Take the diagnostics of another node."""
        if len(self._nodes) < 100 or name in self._nodes:
            self._nodes[name] = {"level": level, "message": message[:200],
                                 "cpu": values.get("cpu share", ""), "reference": values.get("reference", "")}

    def diagnosed(self, alarm: int, verdict: str) -> None:
        """Take what `diagnose` says of an alarm.

        Args:
            alarm: its number.
            verdict: of the document, as it is shown to a person.
        """
        for entry in self._history:
            if entry["number"] == alarm:
                entry["diagnosed"] = verdict

    def state(self, watcher: Watcher, intake: Intake, now: float) -> None:
        """Send the state of the places, if it is time."""
        alarm = watcher.alarm
        if alarm is not None:
            entry = {"number": watcher.alarms, "diagnosed": "", "since": round(watcher.since_ns * 1e-9, 2),
                     "at": round(watcher.alarm_ns * 1e-9, 2), "place": alarm.place, "effect": alarm.hypothesis,
                     "probability": round(alarm.probability, 3)}
            if self._history and self._history[-1]["number"] == watcher.alarms:  # what is likeliest may change
                entry["diagnosed"] = self._history.pop()["diagnosed"]
            self._history.append(entry)
        if now < self._sent_at + STATE_S:
            return
        self._sent_at = now
        places = {name: {"state": p.state, "gap": _number(p.gap), "limit": _number(p.limit),
                         "residual": _number(p.residual), "effect": p.effect,
                         "probability": _number(p.probability), "since": p.since_ns * 1e-9}
                  for name, p in watcher.places.items()}
        self._state = json.dumps({"state": {
            "places": places, "note": watcher.note, "parted": any(p["state"] == PARTED for p in places.values()),
            "history": list(self._history), "nodes": self._nodes, "lost": intake.lost,
            "free": {c: _number(g) for c, g in watcher.free_gap.items()}}})
        self._loop.call_soon_threadsafe(self._send, self._state)


def _write(viewer: _Viewer, text: str) -> None:
    """Send to a viewer, who may have gone: `on_close` tells then."""
    with suppress(tornado.websocket.WebSocketClosedError):
        viewer.write_message(text).add_done_callback(asyncio.Future.exception)


def _number(x: float) -> float | None:
    """A number as JSON has it, short; None if it is not finite."""
    return float(f"{x:.4g}") if math.isfinite(x) else None
