"""``hiros process --view``: what is being processed, while it is."""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from statistics import median

import rerun as rr

from hiros_mcap.events import Events
from hiros_mcap.frames import Block
from hiros_mcap.io.log import Log
from hiros_mcap.running.observe import DETECTIONS
from hiros_mcap.skeletons import Frame
from hiros_viewer.blueprint import Content
from hiros_viewer.destinations import connected, running_viewer, web_server
from hiros_viewer.legend import explain, lay_out
from hiros_viewer.poses import Gatherer
from hiros_viewer.replay import content_of, describe
from hiros_viewer.scene import Scene

BATCH = 120
"""Frames of a file that are drawn at once."""
_PERIOD_S, _SHARE = 1 / 15, 0.25
"""Live, what came is drawn so often, if that takes no more than this share of the time."""
_BEYOND_M = 0.5  # how far people are outside of the room that is shown, until it is shown anew
_RECENT = 30  # results whose delay is shown


class LiveView:
    """A :class:`~hiros_mcap.running.pipeline.Watcher` that draws until its viewer is closed."""

    def __init__(
        self,
        recording: rr.RecordingStream,
        is_open: Callable[[], bool],
        closed: Callable[[], None],
    ) -> None:
        self._recording = recording
        self._is_open, self._closed = is_open, closed
        self._scene: Scene | None = None
        self._names: dict[str, str] = {}
        self._waiting = Gatherer()
        self._laid_out = self._is_live = False
        self._due = 0.0  # when to draw next, s of a monotonic clock
        self._delays: deque[int] = deque(maxlen=_RECENT)  # ns, of the latest results

    def begin(self, log: Log, chain: Sequence[str]) -> None:
        """Draw the cameras."""
        source = describe(log)
        self._names = dict(source.names)
        self._scene = Scene(self._recording, source.model, final=chain[-1])
        self._is_live = log.is_live
        # A live log has no span yet: the first frame is its start.
        self._scene.start = None if log.is_live else source.start
        self._scene.begin(source.cameras, source.later)
        content = content_of([self._scene])
        self._lay_out(replace(content, stages=list(chain)))

    def frame(self, channel: str, frame: Frame) -> None:
        """Draw a frame, as long as somebody looks."""
        scene = self._scene
        if scene is None or (self._is_live and channel not in (DETECTIONS, scene.final)):
            return  # the layout shows no other stage
        camera = self._names.get(frame.source, frame.source) if channel == DETECTIONS else ""
        self._waiting.add([(channel, camera)], Block.of(frame))
        if channel == scene.final:
            self._delays.append(frame.log_time - frame.stamp)
        now = time.monotonic()
        if now >= self._due if self._is_live else self._waiting.size >= BATCH:
            scene.draw(self._waiting.rest())
            self._follow(scene)
            self._due = now + max(_PERIOD_S, (time.monotonic() - now) / _SHARE)

    def _follow(self, scene: Scene) -> None:
        """Stop when the viewer was closed; lay the views out anew once people are known."""
        if not self._is_open():
            self._scene = None
            self._closed()
        elif not self._laid_out and scene.bounds:
            self._laid_out = True
            self._lay_out(content_of([scene]))
        elif self._laid_out:
            content = content_of([scene])
            if self._is_live and self._outgrows(content):
                self._lay_out(content)
            # By now there may be more to name.
            explain(self._recording, content, note=self._delay())

    def _outgrows(self, content: Content) -> bool:
        """Whether somebody is new, or farther out than the layout shows."""
        (low, high), (lowest, highest) = content.box, self._shown.box
        far = (low < lowest - _BEYOND_M).any() or (high > highest + _BEYOND_M).any()
        return bool(far or list(content.people) != list(self._shown.people))

    def _lay_out(self, content: Content) -> None:
        self._shown = content
        lay_out(self._recording, content, follows=self._is_live)

    def _delay(self) -> str:
        """Return in words how long after their time live results were known."""
        if not (self._is_live and self._delays):
            return ""
        return f"**Delay**: {median(self._delays) / 1e9:.2f} s."

    def end(self, events: Events) -> None:
        """Draw the events and what is left."""
        if self._scene is not None and self._is_open():
            self._scene.draw(self._waiting.rest())
            for event in sorted(events.log, key=lambda event: event.stamp):
                self._scene.event(event)
            self._scene.finish()
            content = content_of([self._scene])
            self._lay_out(content)
            explain(self._recording, content, note=self._delay())
            self._recording.flush()
        self._scene = None


@contextmanager
def live_view(name: str, closed: Callable[[], None]) -> Iterator[LiveView]:
    """Open a viewer's window and yield what draws into it; the window stays open.

    ``closed`` is called if the user closes it while the run goes on.

    Raises HirosError if the viewer does not start.
    """
    with running_viewer() as (url, process), connected(url, process, name) as recording:
        yield LiveView(recording, lambda: process.poll() is None, closed)


@contextmanager
def live_page(
    name: str, closed: Callable[[], None], announce: Callable[[str], None]
) -> Iterator[LiveView]:
    """Serve the web viewer and yield what draws into it; serve until it is interrupted.

    ``announce`` is told the address to open. ``closed`` is called if the server ends too early.

    Raises HirosError if the server does not start.
    """
    with web_server() as (page, url, server):
        announce(page)
        with connected(url, server, name) as recording:
            yield LiveView(recording, lambda: server.poll() is None, closed)
        server.wait()
