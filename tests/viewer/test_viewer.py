"""The real viewer, without a screen: it opens what hiros writes, and shows it."""

from __future__ import annotations

import re
import signal
import subprocess
import sys
import threading
import time
from contextlib import contextmanager
from pathlib import Path
from urllib.request import urlopen

import numpy as np
import pytest
from viewers import (
    LOOPBACK,
    Browser,
    fault_of_headless_viewer,
    headless,
    listeners,
    need_chromium,
    picture,
    pixels_like,
    settled_picture,
)
from whole_commands import first_seconds

from hiros_cli.app import run
from hiros_mcap.io.container.live_input import McapInput
from hiros_mcap.io.export.markers import person_colour
from hiros_mcap.io.log import open_log
from hiros_mcap.running.pipeline import ProcessOptions, process
from hiros_mcap.running.process_live import process_live
from hiros_viewer.blueprint import LAYOUTS, Content, blueprint
from hiros_viewer.palette import curve_colour
from hiros_viewer.poses import Poses


@pytest.fixture(scope="module")
def processed(crossing, tmp_path_factory):
    out = tmp_path_factory.mktemp("viewer") / "crossing.hiros.mcap"
    process(crossing, out)
    return out


def start_of(log):
    with open_log(log) as opened:
        return opened.span[0] / 1e9


@pytest.mark.parametrize("layout", LAYOUTS)
def test_every_layout_opens_without_a_complaint(processed, tmp_path, layout):
    target = tmp_path / "log.rrd"
    with headless() as (url, _):
        from rerun.experimental import ViewerClient

        assert run(["view", str(processed), "--save", str(target), "--layout", layout, "-q"]) == 0
        with ViewerClient.connect(url) as client:
            client.open(str(target))
            wait_until_loaded(client)
            client.set_time("stamp", timestamp=start_of(processed) + 1.0, play_state="paused")
            image = picture(settled_picture(client))
            views = client.get_state().views
            assert views
            assert [report for view in views for report in view.reports] == []
    for person in (0, 1):
        assert pixels_like(image, person_colour(person)) > 100


def test_a_raw_recording_has_bright_detections_and_no_empty_views(crossing, tmp_path):
    target = tmp_path / "raw.rrd"
    with headless() as (url, _):
        from rerun.experimental import ViewerClient

        assert run(["view", str(crossing), "--save", str(target), "-q"]) == 0
        with ViewerClient.connect(url) as client:
            client.open(str(target))
            wait_until_loaded(client)
            client.set_time("stamp", timestamp=start_of(crossing) + 1.0, play_state="paused")
            views = client.get_state().views
            (room,) = [view for view in views if view.view_class == "3D"]
            image = picture(settled_picture(client, room.view_id))
    assert len(views) == 3  # with the legend
    for camera in (0, 1, 2):
        assert pixels_like(image, curve_colour(camera), apart=15) > 100


def wait_until_loaded(client, seconds=30.0):
    end = time.monotonic() + seconds
    while time.monotonic() < end:
        state = client.get_state()  # type: ignore[attr-defined]
        if not state.loading and state.views:
            return
        time.sleep(0.1)
    raise AssertionError("the recording does not load")


def test_an_ended_track_is_not_shown(whole_crossing, tmp_path):
    """Person 1 leaves the log after 1 s: seen at 0.5 s, no pixel nor trail at 3.2 s."""
    from hiros_viewer import destinations, replay

    target = tmp_path / "left.rrd"
    log, processed = tmp_path / "crossing.mcap", tmp_path / "crossing.hiros.mcap"
    process(first_seconds(whole_crossing, 3.4, log), processed)
    cut = round((start_of(processed) + 1.0) * 1e9)

    def draw(recording):
        with open_log(processed, topics=["/hiros/filtered"], output_prefix="/none") as log:
            scene = replay.Scene(recording, log.model)  # type: ignore[arg-type]
            scene.begin({})
            for frame in log.frames():
                keep = [p == 0 or frame.stamp < cut for p in frame.ids.tolist()]
                scene.draw({("filtered", ""): Poses.of(frame.select(np.array(keep)))})
            scene.finish()
            content = replay.content_of([scene])
        recording.send_blueprint(blueprint(content))

    destinations.save(target, "left", draw)
    counts = {}
    with headless() as (url, _):
        from rerun.experimental import ViewerClient

        with ViewerClient.connect(url) as client:
            client.open(str(target))
            wait_until_loaded(client)
            (room,) = [v for v in client.get_state().views if v.view_class == "3D"]
            for second in (0.5, 3.2):
                client.set_time(
                    "stamp", timestamp=start_of(processed) + second, play_state="paused"
                )
                image = picture(settled_picture(client, room.view_id))
                counts[second] = [pixels_like(image, person_colour(p)) for p in (0, 1)]
    assert min(counts[0.5]) > 100
    assert counts[3.2][0] > 100
    assert counts[3.2][1] == 0


def test_the_viewer_listens_on_the_loopback_address_alone():
    with headless() as (_, viewer):
        addresses = listeners(viewer.pid)
        assert addresses
        assert set(addresses) <= LOOPBACK


def test_live_view_shows_the_run_and_outlives_it(crossing, tmp_path):
    from hiros_viewer.destinations import new_recording
    from hiros_viewer.live import LiveView

    with headless() as (url, viewer):
        from rerun.experimental import ViewerClient

        recording = new_recording("live")
        recording.connect_grpc(url)
        view = LiveView(recording, lambda: viewer.poll() is None, lambda: None)
        process(crossing, tmp_path / "out.mcap", watcher=view)
        recording.disconnect()
        with ViewerClient.connect(url) as client:
            wait_until_loaded(client)
            client.set_time("stamp", timestamp=start_of(crossing) + 1.0, play_state="paused")
            image = picture(settled_picture(client))
            reports = [report for view_ in client.get_state().views for report in view_.reports]
        assert reports == []
    assert pixels_like(image, person_colour(0)) > 100


@pytest.mark.parametrize(
    ("people", "far", "is_new"), [((0,), 0.4, False), ((0,), 0.6, True), ((0, 1), 0.0, True)]
)
def test_a_live_room_grows_with_its_people(people, far, is_new):
    from hiros_viewer import live
    from hiros_viewer.destinations import new_recording

    def content(who, metres):
        box = np.array([[[-1.0, -1.0, 0.0], [1.0, 1.0 + metres, 2.0]]])
        return Content(stages=("filtered",), people=who, cameras=("camera_0",), boxes=box)

    view = live.LiveView(new_recording("room"), lambda: True, lambda: None)
    view._lay_out(content((0,), 0.0))
    assert view._outgrows(content(people, far)) == is_new


def test_live_input_is_followed_as_it_comes(whole_crossing, tmp_path, monkeypatch):
    """The cursor stays at what came last, and seconds count from the first message."""
    from hiros_viewer import live
    from hiros_viewer.destinations import new_recording

    notes: list[str] = []
    explained = live.explain

    def noting(recording, content, layout="overview", note=""):
        notes.append(note)
        explained(recording, content, layout, note)

    monkeypatch.setattr(live, "explain", noting)
    log = tmp_path / "log.mcap"
    first_seconds(whole_crossing, 3.2, log)
    with headless() as (url, viewer), log.open("rb", buffering=0) as file:
        from rerun.experimental import ViewerClient

        recording = new_recording("live")
        recording.connect_grpc(url)
        view = live.LiveView(recording, lambda: viewer.poll() is None, lambda: None)
        options = ProcessOptions(system="fuse-realtime")
        process_live(McapInput(file.fileno(), "pipe"), None, options=options, watcher=view)
        recording.disconnect()
        with ViewerClient.connect(url) as client:
            wait_until_loaded(client)
            settled_picture(client)
            shown = client.get_state().recordings[0]
    (line,) = (each for each in shown.timelines if each.name == "seconds from start")
    assert line.start == 0
    assert 3e9 < line.end < 60e9
    assert shown.current_time == line.end
    assert re.fullmatch(r"\*\*Delay\*\*: 0\.\d\d s\.", notes[-1])


def test_the_viewers_death_does_not_stop_the_processing(crossing, tmp_path):
    from hiros_viewer.destinations import new_recording
    from hiros_viewer.live import LiveView

    told = []
    with headless() as (url, viewer):
        recording = new_recording("live")
        recording.connect_grpc(url)
        view = LiveView(recording, lambda: viewer.poll() is None, lambda: told.append("closed"))

        class Killer(LiveView):
            count = 0

            def frame(self, channel, frame):
                Killer.count += 1
                if Killer.count == 100:
                    viewer.kill()
                    viewer.wait()
                view.frame(channel, frame)

            def begin(self, log, chain):
                view.begin(log, chain)  # type: ignore[arg-type]

            def end(self, events):
                view.end(events)

        killer = Killer(recording, lambda: True, lambda: None)
        process(crossing, tmp_path / "out.mcap", watcher=killer)
    process(crossing, tmp_path / "alone.mcap")
    assert told == ["closed"]
    assert (tmp_path / "out.mcap").read_bytes() == (tmp_path / "alone.mcap").read_bytes()


@contextmanager
def served(log):
    """Run ``hiros view --web``; yield it and the address that it names."""
    command = [sys.executable, "-m", "hiros_cli", "view", str(log), "--web", "-q"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as server:
        assert server.stdout is not None
        line = server.stdout.readline()
        try:
            assert line.startswith("open http://127.0.0.1:"), line
            yield server, line.split()[1]
        finally:
            server.terminate()


def children_of(pid):
    return [
        int(path.name)
        for path in Path("/proc").iterdir()
        if path.name.isdigit()
        and (path / "stat").exists()
        and int((path / "stat").read_text().rsplit(")", 1)[1].split()[1]) == pid
    ]


@pytest.mark.parametrize(("sent", "at_once"), [(signal.SIGINT, True), (signal.SIGTERM, False)])
def test_the_web_viewer_listens_on_the_loopback_address_until_it_is_stopped(
    processed, sent, at_once
):
    with served(processed) as (server, _):
        end = time.monotonic() + 20
        addresses: list[str] = []
        while not at_once and time.monotonic() < end and len(addresses) < 2:
            addresses = [a for pid in children_of(server.pid) for a in listeners(pid)]
            time.sleep(0.05)
        children = children_of(server.pid)
        said = "".join(Path(f"/proc/{pid}/cmdline").read_text() for pid in children)
        server.send_signal(sent)
        assert server.wait(timeout=60) == 128 + sent
    assert at_once or len(addresses) >= 2
    assert set(addresses) <= LOOPBACK
    assert children
    # A server drops the beginning of a log beyond 1 GB, unless it is told otherwise.
    assert "--server-memory-limit\x0050%" in said
    assert not [pid for pid in children if Path(f"/proc/{pid}").exists()]


def test_the_web_viewer_shows_skeletons(processed, tmp_path):
    chromium = need_chromium()
    shown = [0, 0]
    with (
        served(processed) as (_, address),
        Browser(chromium, tmp_path / "profile", f"{address}&renderer=webgl") as browser,
    ):
        end = time.monotonic() + 120
        while time.monotonic() < end and min(shown) <= 100:
            time.sleep(2)
            image = picture(browser.screenshot())
            shown = [pixels_like(image, person_colour(person)) for person in (0, 1)]
    assert min(shown) > 100


def test_the_window_ends_with_one_line_where_there_is_no_screen(processed, monkeypatch, capsys):
    without_screen(monkeypatch)
    assert run(["view", str(processed), "-q"]) == 2
    assert "there is no screen here; use --web" in capsys.readouterr().err
    assert threading.active_count() < 20


def without_screen(monkeypatch):
    if sys.platform != "linux":
        pytest.skip("elsewhere there is always a screen")
    for name in ("DISPLAY", "WAYLAND_DISPLAY", "WAYLAND_SOCKET"):
        monkeypatch.delenv(name, raising=False)


def test_a_run_without_a_screen_says_how_to_look_at_its_result(
    crossing, tmp_path, monkeypatch, capsys
):
    without_screen(monkeypatch)
    out = tmp_path / "out.mcap"
    assert run(["process", str(crossing), "-o", str(out), "--view", "-q"]) == 0
    assert f"hiros view {out} --web" in capsys.readouterr().err
    assert out.exists()


def test_a_run_without_a_screen_is_served_as_a_page(crossing, tmp_path):
    from hiros_viewer.live import live_page

    pages: list[str] = []
    with pytest.raises(KeyboardInterrupt), live_page("live", lambda: None, pages.append) as view:
        process(crossing, tmp_path / "out.mcap", watcher=view)
        with urlopen(pages[0], timeout=10) as page:
            assert b"Rerun" in page.read()
        raise KeyboardInterrupt
    with pytest.raises(OSError):
        urlopen(pages[0], timeout=1)


def test_without_a_driver_there_is_a_reason_to_skip(monkeypatch):
    for name in ("VK_DRIVER_FILES", "VK_ICD_FILENAMES"):
        monkeypatch.setenv(name, "/nonexistent")
    assert "mesa-vulkan-drivers" in fault_of_headless_viewer.__wrapped__()
