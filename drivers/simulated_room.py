"""The simulated operating room in a process of its own, with the devices that fgreg.drivers.simulated connects to.

Each connection begins with ``{"role": ...}``. ``camera``, ``probe``, ``scanner`` (B-mode pictures) and ``motion`` (the
endoscope's holder) only send; ``stage`` receives the plane's angle; ``operator`` is the surgeon, who sends commands and
can be asked to go on. ``truth`` is no device: it sends the ground truth, to evaluate a recorded session. Camera and
probe have their own clocks. The process is a worker process; its work is to set and remove devices' faults
(:data:`FAULTS`).
"""

from __future__ import annotations

import contextlib
import json
import math
import os
import queue
import socket
import threading
import time
from collections import deque
from collections.abc import Iterator
from contextlib import AbstractContextManager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from fgreg.drivers.simulated_wire import WireClosed, receive, send
from fgreg.simulation.room import Room, room_config
from fgreg.workers.worker_process import Work

CAMERA_CLOCK_S, PROBE_CLOCK_S = 1000.0, 52000.0
"""Readings of the devices' clocks when the room starts."""
PICTURE_RATE = 4.0
"""Largest number of B-mode pictures per second; they come between pulses."""
FRAMES_WAITING, PULSES_WAITING = 2, 64
"""Largest number of unread frames and pulses; after that the oldest is dropped."""
SLOW_S = 0.06
"""Where a picture takes longer, the next one waits half as long: the machine has more to do than the room."""
SETTLE_S = 0.4
"""The surgeon sends an aim once the fibre has been still for this long."""
SAY_AGAIN_S = 3.0
"""Time after which an aim without an effect is sent again."""
MOST_TRIES = 3
"""Aims without an effect at one place; then the surgeon aims in another way."""
LOOKS_S = 1.5
"""Time that the surgeon takes to inspect the stage before a reset."""
FAULTS = {
    "camera": ("", "gone", "silent", "frozen", "black"),
    "probe": ("", "gone", "silent"),
    "motion": ("", "gone", "silent"),
    "scanner": ("", "gone"),
    "stage": ("", "gone"),
    "operator": ("", "gone"),
}
"""Faults of each device: none; unplugged; sends nothing; repeats one picture; sends black pictures."""


@dataclass(slots=True, eq=False)
class _Client:
    """A connected driver and the messages that wait to be sent to it."""

    role: str
    connection: socket.socket
    waiting: queue.Queue[tuple[dict[str, Any], tuple[bytes | memoryview, ...]] | None]
    gone: threading.Event = field(default_factory=threading.Event)

    def put(self, header: dict[str, Any], *payload: bytes | memoryview) -> None:
        """Queue a message; for a slow receiver the oldest is dropped, which shows in the headers' ``index``."""
        while True:
            try:
                self.waiting.put_nowait((header, payload))
                return
            except queue.Full:
                with contextlib.suppress(queue.Empty):
                    self.waiting.get_nowait()

    def run(self) -> None:
        while not self.gone.is_set():
            message = self.waiting.get()
            if message is None:
                break
            try:
                send(self.connection, message[0], *message[1])
            except WireClosed:
                break
        self.close()

    def close(self) -> None:
        self.gone.set()
        with contextlib.suppress(OSError):
            self.connection.shutdown(socket.SHUT_RDWR)
        self.connection.close()
        with contextlib.suppress(queue.Full):
            self.waiting.put_nowait(None)


class RoomServer:
    """Runs a room in real time and serves its devices.

    Args:
        room: the simulated scene.
        path: of the Unix socket; only this user should have access to its folder.
        frame_rate, pulse_rate: of camera and laser, per second.
        roam_s: while the stage follows, the surgeon goes on by himself after this time at a place.

    Attributes:
        start_s: host time of the room's start.
    """

    def __init__(
        self, room: Room, path: Path, *, frame_rate: float = 30.0, pulse_rate: float = 10.0, roam_s: float = math.inf
    ) -> None:
        self.room, self._frame_rate, self._pulse_rate, self._roam_s = room, frame_rate, pulse_rate, roam_s
        self._listener = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
        self._listener.bind(os.fspath(path))
        self._listener.listen(16)
        self._lock = threading.Lock()
        self._clients: list[_Client] = []
        self._asked: queue.Queue[dict[str, Any]] = queue.Queue()
        self._end = threading.Event()
        self._planes: deque[tuple[float, float]] = deque(
            [(0.0, 0.0)], maxlen=128
        )  # when, and where the plane truly stood
        self.start_s = time.monotonic()
        self._said_s = self._pictured_s = -math.inf
        self._tries = 0
        self._pictures = 0
        self._followed = False
        self._faults = dict.fromkeys(FAULTS, "")
        self._frozen: tuple[bytes | memoryview, ...] | None = None
        self._stages: list[socket.socket] = []
        self._answers: list[tuple[float, str]] = []  # of the surgeon, and when he gives them

    def fault(self, device: str, what: str) -> None:
        """Set a device's fault, or remove it. Raises ValueError if it is none of :data:`FAULTS`."""
        if what not in FAULTS.get(device, ()):
            raise ValueError(f"{device} {what!r}, expected one of {FAULTS}")
        self._faults[device], self._frozen = what, None
        if what == "gone":
            with self._lock:
                stages = self._stages if device == "stage" else []
            for client in self._to(device):
                client.close()
            for connection in stages:
                with contextlib.suppress(OSError):
                    connection.shutdown(socket.SHUT_RDWR)

    # --- clients ----------------------------------------------------------------------------------------------------

    def _accept(self) -> None:
        while not self._end.is_set():
            try:
                connection, _ = self._listener.accept()
            except OSError:
                return
            threading.Thread(target=self._serve, args=(connection,), daemon=True).start()

    def _serve(self, connection: socket.socket) -> None:
        try:
            connection.settimeout(5.0)
            header, _ = receive(connection)
            connection.settimeout(None)
        except (WireClosed, OSError):
            connection.close()
            return
        role = header.get("role")
        if self._faults.get(str(role)) == "gone":
            connection.close()
            return
        if role == "stage":
            self._turn(connection)
            return
        if role == "truth":
            self._send_truth(connection)
            return
        if role not in ("camera", "probe", "scanner", "motion", "operator"):
            connection.close()
            return
        client = _Client(
            role, connection, queue.Queue(PULSES_WAITING if role in ("probe", "operator") else FRAMES_WAITING)
        )
        with self._lock:
            self._clients.append(client)
        threading.Thread(target=client.run, daemon=True).start()
        try:
            while True:
                header, _ = receive(connection)
                if role == "operator":
                    self._asked.put(header)
        except WireClosed:
            client.close()
        with self._lock:
            self._clients.remove(client)

    def _turn(self, connection: socket.socket) -> None:
        """Receive the stage's angle."""
        with self._lock:
            self._stages.append(connection)
        try:
            while True:
                header, _ = receive(connection)
                self._planes.append((float(header["at_s"]) - self.start_s, float(header["scan"])))
        except (WireClosed, KeyError, TypeError, ValueError):
            connection.close()
        with self._lock:
            self._stages.remove(connection)

    def _send_truth(self, connection: socket.socket) -> None:
        """Send the result of :meth:`Room.truth_at`, with all times on the host's clock."""
        start = self.start_s
        try:
            _, payload = receive(connection)
            asked = json.loads(payload)
            camera, spots = ([float(t) - start for t in asked[key]] for key in ("camera_s", "spots_s"))
            truth = self.room.truth_at(camera, spots)
            truth["moved_s"] = [t + start for t in truth["moved_s"]]
            send(connection, {}, json.dumps(truth).encode())
        except (WireClosed, ValueError, KeyError, TypeError):
            pass
        connection.close()

    def _to(self, role: str) -> list[_Client]:
        with self._lock:
            return [client for client in self._clients if client.role == role and not client.gone.is_set()]

    # --- time -------------------------------------------------------------------------------------------------------

    def _scan_at(self, t_s: float) -> float:
        """Where the plane stood at a time, also where its data are made late on a busy machine."""
        times, angles = np.array(self._planes).T
        return float(np.interp(t_s, times, angles))

    def now_s(self) -> float:
        """Seconds since the room started."""
        return time.monotonic() - self.start_s

    def run(self) -> None:
        """Run until :meth:`stop`."""
        threading.Thread(target=self._accept, daemon=True).start()
        frame = pulse = 0
        while not self._end.is_set():
            due_frame, due_pulse = frame / self._frame_rate, (pulse + 0.37) / self._pulse_rate
            due = min(due_frame, due_pulse)
            wait = due - self.now_s()
            if wait > 0 and self._end.wait(wait):
                break
            now = self.now_s()
            self._live(now)
            if due_pulse <= due_frame:
                self._pulse(due_pulse, pulse)
                self._picture(due_pulse)
                pulse = max(pulse + 1, math.floor((now - 0.2) * self._pulse_rate))
            else:
                self._frame(due_frame, frame)
                took = self.now_s() - now
                free = now + 1.5 * took if took > SLOW_S else now  # what cannot be kept up with is skipped
                frame = max(frame + 1, math.floor(free * self._frame_rate))
        self._listener.close()
        for client in list(self._clients):
            client.close()

    def stop(self) -> None:
        """End :meth:`run`."""
        self._end.set()

    def _frame(self, t_s: float, index: int) -> None:
        for holder in self._to("motion") if self._faults["motion"] != "silent" else ():
            pose = self.room.base_T_camera(t_s, index)
            holder.put({"index": index, "device_s": CAMERA_CLOCK_S + t_s, "pose": pose.tolist()})
        clients, fault = self._to("camera"), self._faults["camera"]
        if not clients or fault == "silent":
            return
        left, right = self.room.pictures(t_s, index)
        header = {"index": index, "device_s": CAMERA_CLOCK_S + t_s, "shape": list(left.shape)}
        sent: tuple[bytes | memoryview, ...] = (left.data.cast("B"), right.data.cast("B"))
        if fault == "frozen":
            self._frozen = sent = self._frozen or sent
        elif fault == "black":  # but for the sensor's noise
            sent = tuple((side % 4).astype(side.dtype).tobytes() for side in (left, right))
        for client in clients:
            client.put(header, *sent)

    def _pulse(self, t_s: float, index: int) -> None:
        clients = self._to("probe")
        if not clients or self._faults["probe"] == "silent":
            return
        data = self.room.channel_data(t_s, self._scan_at(t_s), index)
        header = {"index": index, "device_s": PROBE_CLOCK_S + t_s, "shape": list(data.shape)}
        for client in clients:
            client.put(header, data.tobytes())

    def _picture(self, t_s: float) -> None:
        clients = self._to("scanner")
        if not clients or t_s - self._pictured_s < 1.0 / PICTURE_RATE:
            return
        self._pictured_s = t_s
        image, pixel_mm, origin_mm = self.room.bmode(self._scan_at(t_s), self._pictures)
        header = {
            "index": self._pictures,
            "device_s": PROBE_CLOCK_S + t_s,
            "shape": list(image.shape),
            "pixel_mm": pixel_mm,
            "origin_mm": origin_mm,
        }
        self._pictures += 1
        for client in clients:
            client.put(header, image.tobytes())

    # --- the surgeon ------------------------------------------------------------------------------------------------

    def _live(self, now_s: float) -> None:
        """Step the surgeon's actions and the room's events."""
        room = self.room
        room.pass_to(now_s)
        go_on = False
        with contextlib.suppress(queue.Empty):
            while True:
                asked = self._asked.get_nowait()
                go_on |= asked.get("next") is True
                if isinstance(asked.get("say"), str):
                    self._followed = asked["say"] == "follow"
                    self._answers.append((now_s + LOOKS_S * (asked["say"] == "reset"), asked["say"]))
        for answer in [answer for answer in self._answers if answer[0] <= now_s]:
            self._answers.remove(answer)
            self._say({"says": answer[1]})
        rested = now_s - room.arrives_s()
        roams = self._followed and rested > self._roam_s
        if (go_on and rested > 0) or roams:
            room.proceed(now_s)
            self._said_s, self._tries = -math.inf, 0
        elif rested > SETTLE_S and now_s - self._said_s > SAY_AGAIN_S and room.place.corner is not None:
            if self._tries == MOST_TRIES:
                room.go_elsewhere(now_s)
                self._said_s, self._tries = -math.inf, 0
                return
            self._said_s = now_s
            self._tries += 1
            self._say({"says": "aim", "corner": list(room.place.corner)})

    def _say(self, words: dict[str, Any]) -> None:
        for client in self._to("operator"):
            client.put(words)


@contextlib.contextmanager
def serving(server: RoomServer) -> Iterator[Work[tuple[str, str], None]]:
    """Run a room. The work is to set or remove a device's fault: :meth:`RoomServer.fault` with the request."""
    thread = threading.Thread(target=server.run, name="room")
    thread.start()
    try:
        yield lambda fault: server.fault(*fault)
    finally:
        server.stop()
        thread.join()


def simulated(
    path: Path, seed: int, width_px: int, aims: int, bump_every_s: float, static_tags: int = 0
) -> AbstractContextManager[Work[tuple[str, str], None]]:
    """Run a room (fgreg.simulation.room) whose devices are reached by the Unix socket at ``path``."""
    config = room_config(seed, width_px, aims=aims, bump_every_s=bump_every_s, static_tags=static_tags)
    return serving(RoomServer(Room(config), path))
