"""Notes on cameras and people while a run goes on, and their words."""

from __future__ import annotations

import re
import time
from collections import defaultdict
from pathlib import Path
from typing import cast

import numpy as np
import pytest
from stick_figures import MODEL, at, person, seen

from hiros_cli.run_report import _limbs
from hiros_mcap import stages
from hiros_mcap.body.limb_table import Limb, LimbTable
from hiros_mcap.defaults import LEAST_CONFIDENCE
from hiros_mcap.events import COUNTED, TOO_LATE, counted
from hiros_mcap.frames import Block
from hiros_mcap.io.log import Log, Reading
from hiros_mcap.running.clock_alignment import ClockAlignment
from hiros_mcap.running.observe import (
    DETECTIONS,
    DetectionSample,
    MessageRate,
    Observer,
    Stopwatch,
)
from hiros_mcap.running.pose_alignment import PoseAlignment
from hiros_mcap.running.preparation import Prepared
from hiros_mcap.running.process_options import ProcessOptions
from hiros_mcap.running.report import Report
from hiros_mcap.running.summary import LimbSummary
from hiros_mcap.systems import Run
from hiros_mcap.wording import duration, number, quantity

MS, S = 1_000_000, 1_000_000_000


def rate(*stamps):
    """A camera that sent messages stamped at these times, s."""
    result = MessageRate()
    for some in stamps[:2], stamps[2:]:  # of two blocks
        if some:
            result.add(np.array([round((100 + stamp) * S) for stamp in some]))
    return result


def test_the_rate_is_that_of_the_intervals_without_pauses():
    assert rate(0, 0.1, 0.2, 5.0, 5.1).hertz == pytest.approx(10)
    assert np.isnan(rate(0).hertz)


def test_a_message_out_of_order_does_not_count_for_the_rate():
    assert rate(0, 0.1, 0.05, 0.15).hertz == pytest.approx(10)


def sample(scale, confidence):
    result = DetectionSample()
    frame = seen([person()], at(0))
    frame.markers[..., :3] *= scale
    frame.marker_confidences[...] = confidence
    result.add(Block.of(frame))
    return result


@pytest.mark.parametrize("confidences", [(0.5, 0.0), (0.0, 0.5)])
def test_one_marker_with_a_confidence_is_enough(confidences):
    result = DetectionSample()
    for k, confidence in enumerate(confidences):
        frame = seen([person()], at(k))
        frame.marker_confidences[...] = confidence
        result.add(Block.of(frame))
    assert list(result.reasons()) == []


@pytest.mark.parametrize(
    ("scale", "confidence", "words"),
    [
        (1000.0, 1.0, ["looks like millimetres"]),
        (1.0, 0.0, ["confidence 0"]),
        (1000.0, 0.0, ["looks like millimetres", "confidence 0"]),
        (1.0, 0.5, []),
        (1.0, np.nan, []),
    ],
)
def test_why_nobody_is_found(scale, confidence, words):
    reasons = list(sample(scale, confidence).reasons())
    assert len(reasons) == len(words)
    assert all(word in reason for word, reason in zip(words, reasons, strict=True))


def test_people_are_those_of_the_last_channel_cameras_those_of_the_tracker():
    observer = Observer(["tracked", "merged"])
    for k, source in enumerate("aab"):
        frame = seen([person()], at(k), ids=[7]).replace(source=source)
        observer.see(DETECTIONS, Block.of(frame.replace(ids=np.array([-1], np.int32))))
        observer.see("tracked", Block.of(frame))
    for k in (2, 1, 3):
        observer.see("merged", Block.of(seen([person(), person()], at(k), ids=[7, -1])))
    assert observer.cameras_of(7) == ("a", "b")
    assert [*observer.people] == [7]
    presence = observer.people[7]
    assert (presence.first, presence.last, presence.frames) == (at(1), at(3), 3)
    assert observer.written == {"tracked": 3, "merged": 3}


def test_each_step_is_charged_with_its_own_time_only():
    def work(seconds):
        end = time.thread_time() + seconds
        while time.thread_time() < end:
            pass

    def blocks():
        work(0.03)
        yield Block.of(seen([person()], at(0)))

    def stage(given):
        for block in given:
            work(0.01)
            yield block

    watch = Stopwatch()
    read = watch.timed("read", blocks(), lambda _: work(0.02))
    for _ in watch.timed("tracked", stage(read), lambda _: None):
        work(0.05)
    watch.charge("read", 1.0)
    assert watch.cpu["read"] == pytest.approx(1.03, abs=0.005)
    assert watch.cpu["tracked"] == pytest.approx(0.01, abs=0.005)
    assert watch.cpu["write"] == pytest.approx(0.02, abs=0.005)


def test_every_event_that_a_stage_counts_has_words():
    found: defaultdict[str, list[str]] = defaultdict(list)
    for path in Path(stages.__file__).parent.glob("*.py"):
        for kind in re.findall(r'\.count\(\s*"([^"]+)"', path.read_text()):
            found[kind].append(path.name)
    shown = {"flip", "outlier", TOO_LATE}
    assert found.keys() - shown <= COUNTED.keys()


def test_numbers_of_things_are_told_in_words():
    assert counted("not confirmed", 14) == (
        "14 detections ignored: seen too briefly or by too few cameras"
    )
    assert counted("not confirmed", 1).startswith("1 detection ignored")
    assert counted("something new", 3) == "something new: 3"
    assert counted("confidence above 1", 2) == "2 confidences above 1 taken as 1"
    assert quantity(0, "limb") == "0 limbs"
    assert (number(np.nan, 1), number(2.25, 1, " s")) == ("-", "2.2 s")


@pytest.mark.parametrize(
    ("seconds", "text"),
    [(3.21, "3.2 s"), (3599.0, "3599.0 s"), (3600.0, "1.0 hours"), (86400.0, "1.0 days"),
     (2 * 31_557_600.0, "2.0 years")],
)  # fmt: skip
def test_a_duration_has_the_unit_that_fits(seconds, text):
    assert duration(seconds) == text


def report_on(run):
    observer = Observer(["tracked", "optimized"])
    log, options = cast(Log, None), ProcessOptions()
    prepared = Prepared(log, run.config, options, ClockAlignment(), PoseAlignment(), Stopwatch())
    return Report(prepared, run, observer, cast(Reading, None))


def test_limbs_are_summed_up_by_the_median_and_the_worst():
    limbs = {
        name: Limb(1.0, cv, n) for name, cv, n in (("a", 0.1, 5), ("b", 0.4, 9), ("c", 0.2, 7))
    }
    summary = report_on(Run(MODEL, limbs=LimbTable({3: limbs})))._limbs(3)
    assert summary == LimbSummary(9, 0.2, 0.4, "b", accepted=True)


def test_the_last_reason_why_limbs_were_rejected_is_told():
    run = Run(MODEL)
    for who, why in ((3, "first"), (3, "last"), (4, "of another")):
        run.events.note(0, "calibration rejected", person=who, detail=why)
    summary = report_on(run)._limbs(3)
    assert summary is not None
    assert (summary.accepted, summary.reason) == (False, "last")
    assert report_on(run)._limbs(5) is None


def test_limb_lengths_are_told_in_words():
    limbs = LimbSummary(150, 0.12, 0.45, "HAND_LEFT", accepted=True)
    assert _limbs(limbs) == "150 frames; raw lengths varied by 12 % (worst: HAND_LEFT, 45 %)"
    assert _limbs(LimbSummary(9, np.nan, np.nan, "", accepted=True)) == "9 frames"
    rejected = LimbSummary(0, np.nan, np.nan, "", accepted=False, reason="seen for 0.3 s")
    assert _limbs(rejected) == "not calibrated, skeletons unchanged: seen for 0.3 s"
    assert _limbs(None) == "-"


def test_frames_in_which_a_person_is_merely_predicted_are_counted():
    observer = Observer(["filtered"])
    for k, confidence in enumerate([0.8, LEAST_CONFIDENCE, 0.09, 0.02, np.nan]):
        frame = seen([person()], at(k))
        frame = frame.replace(ids=np.array([4], np.int32), confidences=np.array([confidence]))
        observer.see("filtered", Block.of(frame))
    assert (observer.people[4].frames, observer.people[4].predicted) == (5, 2)


def test_delays_are_those_that_so_many_results_have_at_most():
    observer = Observer(["filtered"])
    for late in [*range(1, 100), 5000]:  # ms
        frame = seen([person()], at(3))
        late_frame = frame.replace(log_time=frame.stamp + late * 1_000_000)
        observer.see("filtered", Block.of(late_frame))
    assert observer.delay(50) == pytest.approx(0.050)
    assert observer.delay(95) == pytest.approx(0.095)
    assert observer.delay(100) == pytest.approx(5.0)
