"""A page at work: clouds come, are registered and shown; a pull at the organ is predicted while the mouse moves."""

from __future__ import annotations

import threading
import time
from collections import deque
from collections.abc import Callable, Iterable, Mapping
from contextlib import AbstractContextManager, ExitStack
from dataclasses import replace
from typing import Any

import numpy as np
import viser
from numpy.typing import NDArray

from softtwin.registration.pose import Pose
from softtwin.registration.result import Registration

from ..record import pose_correction_of
from ..register import registered
from ..streams import Arrival, Mailbox, fed
from ..twin import Camera, Frame, Home, Learner, Sequence, Twin
from .bands import SCALES
from .brush import Brush
from .camera import Shot
from .controls import RECORDED_S, Controls, Wishes, engines_here
from .figures import Figures
from .hand import Hand
from .pull import Prediction, judged
from .recording import Recording
from .scene import Picture
from .values import errors_of, margins_of, shown_values

Floats = NDArray[np.float64]
Learning = Callable[[Twin], AbstractContextManager[Learner | None]]
LEARNERS = ("surrogate", "hybrid")  # engines whose surrogate can learn


class Session:
    """What one page shows of one twin.

    Args:
        server: that shows it.
        home: of the twin.
        is_simulated: whether a simulated camera gives the clouds, with the truth beside them.
        options: entries of [registration] that replace the twin's.
        camera: where the camera stands; a simulated one that is misaligned is looked for near where it should be.
        engine: that registers to begin with; the first that this machine can run if not given.
        learning: makes what adapts the surrogate of a twin that is opened while frames come; nothing does if not given.
    """

    def __init__(
        self,
        server: viser.ViserServer,
        home: Home,
        is_simulated: bool = False,
        options: Mapping[str, Any] | None = None,
        camera: Camera = None,
        engine: str = "",
        learning: Learning | None = None,
    ) -> None:
        self._learning = learning
        self._learner: Learner | None = None
        self._server, self._home, self._options, self._camera = server, home, dict(options or {}), camera
        has_network = (home.folder / "surrogate.json").is_file()
        engines = sorted(engines_here(has_network), key=lambda name: name != engine)
        self._news, self._is_closed, self._watchers, self._settings = threading.Condition(), False, 0, 0
        self.controls = Controls(server, engines, is_simulated, self._on_change)
        self.picture = Picture(server, home.body)
        self._recording: Recording | None = None
        self.brush = Brush(self._draw, np.zeros_like(home.body.points))
        self._resources = ExitStack()
        self._kept: tuple[tuple[str, bool], Sequence] | None = None
        self._forces: Floats = np.zeros_like(home.body.points)
        self._dropped, self._answered = 0, deque[float](maxlen=20)
        self._figures = Figures("registration", engine=engines[0])
        self.hand = Hand(home, self.brush, self._show_prediction, self._let_go) if has_network else None
        if self.hand is not None:
            self.picture.on_drag(self._on_drag)
        self.controls.on_record(self._record_for)
        server.on_client_connect(self._on_come)
        server.on_client_disconnect(self._on_go)

    # What a source of clouds asks.

    @property
    def wishes(self) -> Wishes:
        """What a person has set."""
        return self.controls.wishes

    @property
    def is_closed(self) -> bool:
        """Whether the page has ended."""
        return self._is_closed

    def wait_until_wanted(self, known: int) -> int:
        """Wait until a cloud is of use: somebody looks, nobody pulls, and the organ moves or something was set anew.

        Args:
            known: what this returned before.

        Returns:
            A number that grows with each setting.
        """
        with self._news:
            self._news.wait_for(lambda: self._is_closed or self._wants(known))
            return self._settings

    def _wants(self, known: int) -> bool:
        looked_at = self._watchers > 0 or self._recording is not None
        return looked_at and not self.is_pulled and (self.wishes.is_running or self._settings != known)

    @property
    def is_pulled(self) -> bool:
        """Whether somebody pulls at the organ."""
        return self.hand is not None and self.hand.is_pulling

    # The stream.

    def run(self, shots: Iterable[Shot]) -> None:
        """Register what comes and show it, until the source or the session ends.

        Args:
            shots: at their own pace.
        """
        box: Mailbox = fed(shots)  # type: ignore[arg-type]
        try:
            while not self._is_closed and (arrival := box.take()) is not None:
                self._dropped += arrival.dropped
                if self.is_pulled:
                    self._dropped += 1
                    continue
                self._register(arrival)
        finally:
            self.close()

    def end(self) -> None:
        """Let `run` return, from any thread."""
        with self._news:
            self._is_closed = True
            self._news.notify_all()

    def close(self) -> None:
        """End the threads and give back what the twin holds."""
        self.end()
        if self.hand is not None:
            self.hand.close()
        self.brush.close()
        if self._kept is not None:
            self._kept[1].close()
        self._resources.close()

    def _register(self, arrival: Arrival) -> None:
        shot, wishes = arrival.cloud, self.wishes
        assert isinstance(shot, Shot)
        sequence = self._sequence(wishes)
        begin = time.monotonic()
        frame = registered(sequence, shot.cloud)  # type: ignore[arg-type]
        now = time.monotonic()
        self._answered.append(now)
        self._figures = replace(
            self._figures, frame_time=now - begin, age=now - arrival.at, dropped=self._dropped, rate=self._rate()
        )
        if not self.is_pulled:
            self._show(frame, shot, wishes, sequence.twin)

    def _rate(self) -> float:
        if len(self._answered) < 2:
            return np.nan
        return (len(self._answered) - 1) / max(self._answered[-1] - self._answered[0], 1e-6)

    def _sequence(self, wishes: Wishes) -> Sequence:
        """The sequence of the engine and pose that are asked for; opened anew where those have changed."""
        wanted = wishes.engine, wishes.view.is_misaligned
        if self._kept is not None and self._kept[0] == wanted:
            return self._kept[1]
        same = self._kept is not None and self._kept[0][0] == wanted[0]
        if self._kept is not None:
            self._kept[1].close()
        twin = self._kept[1].twin if same and self._kept is not None else self._opened(wishes.engine)
        camera = twin.near(Pose.identity()) if wishes.view.is_misaligned else self._camera
        self._kept = wanted, Sequence(twin, None, camera, is_live=True, learner=self._learner)
        self._answered.clear()
        return self._kept[1]

    def _opened(self, engine: str) -> Twin:
        self.controls.show(Figures("registration", reason=f"the engine is being opened: {engine}", engine=engine))
        self._resources.close()
        self._figures = Figures("registration", engine=engine)
        twin = self._resources.enter_context(self._home.twin(engine, **self._options))
        self._learner = None
        if self._learning is not None and engine in LEARNERS:
            self._learner = self._resources.enter_context(self._learning(twin))
        return twin

    def _show(self, frame: Frame, shot: Shot, wishes: Wishes, twin: Twin) -> None:
        found, judgement = frame.registration, frame.judgement
        reason = judgement.reasons[0] if judgement.reasons else ""
        if found is None:
            self._figures = replace(
                self._figures, verdict=judgement.verdict, reason=reason, margins={}, errors={}, pose_correction=None
            )
            self.controls.show(self._figures)
            return
        self._forces = found.forces
        margins, errors = margins_of(twin, found), errors_of(twin, found, shot.truth)
        off = pose_correction_of(found)
        self._figures = replace(
            self._figures,
            verdict=judgement.verdict,
            reason=reason,
            margins=margins,
            outside={name: float(outside.mean()) for name, outside in twin.outside.items()},
            errors=errors,
            net_force=float(np.linalg.norm(found.net_force)),
            net_force_deviation=float(np.linalg.norm(found.net_force_deviation)),
            true_net_force=np.nan if shot.net_force is None else float(np.linalg.norm(shot.net_force)),
            pose_correction=None if off is None or not off["is_seen"] else (off["translation_m"], off["rotation_rad"]),
        )
        self.brush.glide(found.displacement)
        self._paint(found, frame, shot, wishes, twin)
        self.picture.name_margins(margins)
        self.controls.show(self._figures)

    def _paint(self, found: Registration, frame: Frame, shot: Shot, wishes: Wishes, twin: Twin) -> None:
        cloud = None if frame.cloud is None else found.pose.inverse().apply(frame.cloud)
        self.picture.show_cloud(cloud)
        values = shown_values(wishes.shows, twin.body, found, shot.truth)
        self.picture.paint(values, SCALES[wishes.shows])

    # The pull.

    async def _on_drag(self, event: Any) -> None:
        assert self.hand is not None
        if event.phase == "start":
            self.hand.take_hold(event.client_id, self.picture.place_of(event.start_position), self._forces)
        place = self.picture.place_of(event.end_position)
        self.hand.move(event.client_id, place)
        if event.phase == "end":
            self.hand.let_go(event.client_id)

    def _show_prediction(self, found: Prediction) -> None:
        error_bound, (verdict, reason) = found.error_bound, judged(found)
        self.picture.show_cloud(None)
        self.controls.describe("movement")
        self.picture.paint(np.linalg.norm(found.displacement, axis=1), SCALES["movement"])
        self.picture.name_margins({})
        self.controls.show(
            Figures(
                "forward prediction of a pull, with its certificate",
                verdict,
                reason,
                bound=np.nan if error_bound is None else error_bound.largest,
                confidence=np.nan if error_bound is None else error_bound.confidence,
                net_force=float(np.linalg.norm(found.pull)),
                frame_time=time.monotonic() - found.asked,
                dropped=self._dropped,
                engine="surrogate",
            )
        )

    def _let_go(self) -> None:
        self.controls.describe(self.wishes.shows)
        self._on_change()

    # What happens in a browser.

    def _on_change(self) -> None:
        with self._news:
            self._settings += 1
            self._news.notify_all()

    def _on_come(self, client: viser.ClientHandle) -> None:
        with self._news:
            self._watchers = len(self._server.get_clients())
        self._on_change()

    def _on_go(self, client: viser.ClientHandle) -> None:
        if self.hand is not None:
            self.hand.let_go(client.client_id)
        with self._news:
            self._watchers = len(self._server.get_clients())
        self._on_change()

    # Recording.

    def record(self, seconds: float, done: Callable[[str], None]) -> None:
        """Record the scene for so many seconds; `done` gets one HTML page that plays it.

        Args:
            seconds: to record.
            done: is called with the page, in a thread of its own.
        """
        with self._news:
            if self._recording is None:
                self._recording = Recording(self._server, seconds, self._recorded(done))
        self._on_change()

    def _record_for(self, client: viser.ClientHandle) -> None:
        self.record(RECORDED_S, lambda page: client.send_file_download("softtwin.html", page.encode()))

    def _recorded(self, done: Callable[[str], None]) -> Callable[[str], None]:
        def end(page: str) -> None:
            with self._news:
                self._recording = None
            done(page)

        return end

    def _draw(self, displacement: Floats) -> None:
        recording = self._recording
        if recording is not None:
            recording.mark()
        self.picture.move(displacement)
